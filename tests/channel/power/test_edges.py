"""How edges are chosen."""

import numpy as np
import pytest

from invertwin.channel import use_backend
from invertwin.channel.power.edges import Proportional
from invertwin.channel.rays.backend import mi


def drawn(weights, count):
    """Entries, rests and probabilities of numbers spread evenly over [0, 1)."""
    spread = (np.arange(count, dtype=np.float32) + 0.5) / count
    with use_backend("cpu"):
        return tuple(np.array(c) for c in Proportional(mi.Float(weights)).draw(mi.Float(spread)))


def test_entries_are_drawn_in_proportion():
    weights = [0.0, 3.0, 0.0, 0.0, 1.0, 4.0, 0.0]
    place, rest, chance = drawn(weights, 8000)
    assert np.bincount(place, minlength=7) / 8000 == pytest.approx(np.array(weights) / 8)
    assert chance == pytest.approx(np.array(weights)[place] / 8)
    for entry in (1, 4, 5):  # evenly within each
        own = np.sort(rest[place == entry])
        assert own == pytest.approx((np.arange(len(own)) + 0.5) / len(own), abs=1e-3)


def test_where_there_is_nothing_no_entry_has_a_chance():
    assert not drawn([0.0, 0.0, 0.0], 10)[2].any()
    place, rest, chance = drawn([0.0, 2.0], 10)
    assert (place == 1).all()
    assert (chance == 1).all()
    assert ((rest >= 0) & (rest < 1)).all()
