"""Spreads, table and conversion of paths that are made up."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from invertwin.channel import RayPaths, trace_paths
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.links import (
    angle_spread,
    delay_spread,
    path_table,
    ray_paths_from_sionna,
    rician_factor,
)
from invertwin.scene import Object, PerfectConductor, Scene, Slab, rigid
from scenes import float64, level_plate


def made(delays: list[float], powers: list[float], directions: list[list[float]]) -> RayPaths:
    """Paths of one of two links, vertical to vertical; the first one is the line of sight."""
    count = len(delays)
    matrix = torch.zeros(count, 2, 2, dtype=torch.complex128)
    matrix[:, 0, 0] = float64(powers).sqrt()
    unit = torch.nn.functional.normalize(float64(directions), dim=1)
    return RayPaths(
        (1, 2),
        1e9,
        torch.zeros(count, dtype=torch.int64),
        torch.ones(count, dtype=torch.int64),
        float64(delays),
        matrix,
        -unit,
        unit,
        torch.zeros(count, 1, 3, dtype=torch.float64),
        (torch.arange(count) > 0).long()[:, None],
        torch.zeros(count, 1, dtype=torch.int64),
        torch.zeros(count, 1, dtype=torch.int64),
        ("wall",),
        torch.zeros(count, dtype=torch.float64),
    )


def test_spreads_of_two_paths():
    # Both in the horizontal plane, 2 · 0.3 rad apart, with shares 3/4 and 1/4.
    turn = [[math.cos(a), math.sin(a), 0.0] for a in (0.3, -0.3)]
    paths = made([1e-8, 5e-8], [3.0, 1.0], turn)
    spread = math.sqrt(3) / 4  # of shares p and 1 − p: √(p(1 − p))
    assert delay_spread(paths)[1, 0].item() == pytest.approx(spread * 4e-8)
    assert rician_factor(paths)[1, 0].item() == pytest.approx(3.0)
    chord = 2 * math.sin(0.3)
    for end in ("departure", "arrival"):
        assert angle_spread(paths, end)[1, 0].item() == pytest.approx(spread * chord)


@pytest.mark.usefixtures("unchecked")
def test_another_end_is_refused():
    paths = made([1e-8], [2.0], [[1.0, 0.0, 0.0]])
    with pytest.raises(InputError, match="departure, arrival"):
        angle_spread(paths, "both")  # type: ignore[arg-type]


def test_links_without_spread():
    one = made([1e-8], [2.0], [[1.0, 0.0, 0.0]])
    for found in (delay_spread(one), angle_spread(one)):
        assert found.tolist() == [[0.0], [0.0]]
    assert rician_factor(one).tolist() == [[0.0], [math.inf]]
    delay = one.delay.clone().requires_grad_()
    delay_spread(replace(one, delay=delay)).sum().backward()
    assert delay.grad is not None
    assert not delay.grad.any()


def test_a_pane_in_the_way_leaves_a_straight_path():
    panes = {"pane": Object(level_plate(9.0, 9.0), Slab.itu("glass", thickness=0.01))}
    panes["wall"] = Object(
        level_plate(9.0, 9.0), PerfectConductor(), rigid(translation=[0.0, 0.0, -3.0])
    )
    paths = trace_paths(Scene(panes), [0, 0, -1], [1, 0, 1], 3.5e9, rays=10_000)
    assert 0 < rician_factor(paths).item() < math.inf
    text = path_table(paths)
    assert len(text.splitlines()) == len(paths) + 1
    assert "transmission pane" in text.splitlines()[1]
    assert "reflection wall, transmission pane" in text
    assert f"{paths.length[0].item():.3f}" in text
    # Departs towards +x and upwards by atan2(2, 1).
    assert "0.00, 63.43" in text.splitlines()[1]


def sionna_like(**changes: object) -> Any:
    """What `PathSolver` returns for two receivers, one transmitter and up to two paths."""
    shape = (2, 2, 1, 2, 2)  # rx, rx antenna, tx, tx antenna, path
    rng = np.random.default_rng(1)
    given: dict[str, object] = {
        "a": (rng.normal(size=shape), rng.normal(size=shape)),
        "valid": np.array([[[True, True]], [[False, True]]]),
        "tau": np.array([[[2e-8, 1e-8]], [[-1.0, 3e-8]]]),
        "interactions": np.array([[[[1, 0]], [[0, 4]]], [[[0, 0]], [[0, 1]]]]),
        "vertices": rng.normal(size=(2, 2, 1, 2, 3)),
        "theta_t": np.full((2, 1, 2), 0.4),
        "phi_t": np.full((2, 1, 2), 0.7),
        "theta_r": np.full((2, 1, 2), 2.0),
        "phi_r": np.full((2, 1, 2), -0.7),
        "doppler": np.full((2, 1, 2), 5.0),
    }
    return SimpleNamespace(**(given | changes))


def test_paths_of_sionna_are_ours():
    theirs = sionna_like()
    found = ray_paths_from_sionna(theirs, 3.5e9)
    assert found.counts == (1, 2)
    assert found.rx.tolist() == [0, 0, 1]
    torch.testing.assert_close(found.delay, float64([1e-8, 2e-8, 3e-8]))
    assert found.kinds.tolist() == [[0, 0], [1, 0], [2, 1]]
    assert not found.vertices[found.kinds == 0].any()
    np.testing.assert_array_equal(found.vertices[2, 1], theirs.vertices[1, 1, 0, 1])
    np.testing.assert_array_equal(found.coefficient[1].real, theirs.a[0][0, :, 0, :, 0])
    np.testing.assert_array_equal(found.coefficient[1].imag, theirs.a[1][0, :, 0, :, 0])
    ring = math.sin(0.4)
    expected = float64([ring * math.cos(0.7), ring * math.sin(0.7), math.cos(0.4)])
    torch.testing.assert_close(found.departure[0], expected)
    assert found.length[0].item() == pytest.approx(1e-8 * SPEED_OF_LIGHT)
    assert "line of sight" in path_table(found)


def test_other_paths_of_sionna_are_refused():
    single = np.zeros((2, 1, 1, 1, 2))
    with pytest.raises(InputError, match="polarization 'VH'"):
        ray_paths_from_sionna(sionna_like(a=(single, single)), 3.5e9)
    diffuse = np.full((2, 2, 1, 2), 2)
    with pytest.raises(InputError, match="diffuse_reflection=False"):
        ray_paths_from_sionna(sionna_like(interactions=diffuse), 3.5e9)
