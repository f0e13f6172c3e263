"""Draws have the moments and the limits of their laws."""

import numpy as np
import pytest

from invertwin.datasets import UNCHANGED, Choice, Integer, LogUniform, Normal, Presence, Uniform
from invertwin.errors import InputError


def draws(law, count=4000):
    generator = np.random.default_rng(1)
    return [law.draw(generator) for _ in range(count)]


def test_uniform_fills_its_limits_entry_by_entry():
    rows = np.array(draws(Uniform([0.0, -3.0, 2.0], [1.0, 3.0, 2.0])))
    assert rows.min(0) == pytest.approx([0.0, -3.0, 2.0], abs=0.01)
    assert rows.max(0) == pytest.approx([1.0, 3.0, 2.0], abs=0.01)
    assert rows.var(0) == pytest.approx([1 / 12, 3.0, 0.0], rel=0.1)
    assert abs(np.corrcoef(rows[:, 0], rows[:, 1])[0, 1]) < 0.05


def test_log_uniform_has_a_uniform_logarithm_and_keeps_its_limits():
    values = np.array(draws(LogUniform(0.1, 10.0)))
    assert np.log10(values).mean() == pytest.approx(0.0, abs=0.03)
    assert np.log10(values).var() == pytest.approx(4 / 12, rel=0.05)
    assert 0.1 <= values.min() < values.max() <= 10.0


def test_normal_has_its_mean_and_deviation():
    rows = np.array(draws(Normal([1.0, 2.0], [0.5, 0.0])))
    assert rows.mean(0) == pytest.approx([1.0, 2.0], abs=0.03)
    assert rows.std(0) == pytest.approx([0.5, 0.0], abs=0.02)


def test_integers_are_whole_and_both_ends_come():
    values = draws(Integer(2, 4))
    assert {type(value) for value in values} == {int}
    assert np.bincount(values)[2:] == pytest.approx([4000 / 3] * 3, rel=0.1)
    assert draws(Integer([1, 5], [1, 5]), 1) == [[1, 5]]


def test_choice_goes_by_its_weights():
    values = draws(Choice(["a", {"b": 1}, [2]], [1.0, 0.0, 3.0]))
    assert {"b": 1} not in values
    assert values.count("a") == pytest.approx(1000, rel=0.1)


def test_presence_keeps_a_key_or_takes_it_away():
    values = draws(Presence(0.25))
    assert values.count(UNCHANGED) == pytest.approx(1000, rel=0.1)
    assert values.count(None) == 4000 - values.count(UNCHANGED)


def test_ends_are_those_that_draws_stay_between():
    assert Uniform([0.0], [1.0]).extreme_values() == [[0.0], [1.0]]
    assert LogUniform(1.0, 2.0).extreme_values() == [1.0, 2.0]
    assert Integer(1, 3).extreme_values() == [1, 3]
    assert Normal(1.0, 2.0).extreme_values() == [1.0]
    assert Choice([1, "a"]).extreme_values() == [1, "a"]
    assert Presence().extreme_values() == [None]


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda: Uniform(1.0, 0.0), "low <= high"),
        (lambda: Uniform([0.0, 1.0], 2.0), "2 and 1 numbers"),
        (lambda: LogUniform(0.0, 1.0), "low > 0"),
        (lambda: Normal([0.0, 1.0], [1.0]), "each of 2 means, got 1"),
        (lambda: Normal(0.0, -1.0), "deviations >= 0"),
        (lambda: Integer(3, 2), "low <= high"),
        (lambda: Choice([]), "got none"),
        (lambda: Choice([1], [1.0, 2.0]), "each of 1 values, got 2"),
        (lambda: Choice([1], [0.0]), "some > 0"),
    ],
)
def test_laws_that_mean_nothing_are_refused(made, said):
    with pytest.raises(InputError, match=said):
        made()
