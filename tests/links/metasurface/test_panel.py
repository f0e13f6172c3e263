"""Metasurfaces: sums over elements against mirrors, foci and shadows that are known."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.func import jvp

from invertwin.channel import trace_paths, visible_fractions
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.links import (
    CellSampling,
    MapPlane,
    Metasurface,
    PropagationSettings,
    Transmitters,
    frequency_response,
    panel_paths,
    received_gain,
)
from invertwin.links.metasurface.panel import panel_response
from invertwin.links.places import ReceiverPoints
from invertwin.models.radio import RadioMap
from invertwin.scene import Cosine, Object, PerfectConductor, Scene, plate, rigid
from scenes import float64

FREQUENCY = 28e9
WAVELENGTH = SPEED_OF_LIGHT / FREQUENCY
AXES = torch.eye(3, dtype=torch.float64)


def aside() -> Scene:
    """A plate far behind the panel, in nobody's way."""
    return Scene(
        {"far": Object(plate(0.1, 0.1), PerfectConductor(), rigid(translation=[-50.0, 0.0, 0.0]))}
    )


def screened(shift: float | Tensor = 0.0) -> Scene:
    """A screen over y > shift at x = 1, in front of a panel at x = 0."""
    place = torch.stack([float64(1.0), torch.as_tensor(shift).double() + 0.5, float64(0.0)])
    pose = torch.eye(4, dtype=torch.float64).index_put(
        (torch.arange(3), torch.full((3,), 3)), place
    )
    return Scene({"screen": Object(plate(1.0, 4.0), PerfectConductor(), pose)})


def panel(count: int, **more: object) -> Metasurface:
    """λ/2 elements about the origin, looking along x."""
    none = torch.zeros(count, count, dtype=torch.float64)
    given = {"phase": none, "spacing": WAVELENGTH / 2} | more
    return Metasurface(float64([0.0, 0.0, 0.0]), AXES, **given)  # type: ignore[arg-type]


def behind(count: int, seed: int = 1) -> Tensor:
    """Receivers beyond a screen."""
    generator = torch.Generator().manual_seed(seed)
    u = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    return u[:, [2, 0, 1]] + float64([1.5, -0.5, -0.5])  # y, z and x in the order of draws


def test_uniform_phases_are_a_mirror():
    tilt = math.radians(20.0)
    tx, rx = (float64([[math.cos(tilt), s * math.sin(tilt), 0.0]]) for s in (-1.0, 1.3))
    rx[:, 0] *= 1.3
    found = panel_response(aside(), panel(int(1.2 / (WAVELENGTH / 2))), tx, rx, FREQUENCY)
    # The phase of the path by the centre is that of the mirror's.
    mirror = -WAVELENGTH / (4 * math.pi) / 2.3
    assert float((found / mirror).abs()) == pytest.approx(1.0013, abs=1e-4)
    assert float((found / mirror).angle()) == pytest.approx(-0.0208, abs=1e-4)


def test_its_paths_have_the_signs_of_a_mirror():
    size = int(1.2 / (WAVELENGTH / 2)) * WAVELENGTH / 2
    mirror = Scene({"mirror": Object(plate(size, size), PerfectConductor())})
    tilt = math.radians(20.0)
    tx, rx = ([abs(s) * math.cos(tilt), s * math.sin(tilt), 0.0] for s in (-1.0, 1.3))
    truth = trace_paths(mirror, tx, rx, FREQUENCY, depth=1, rays=None)
    truth = truth.select(truth.interaction_count == 1)
    found = panel_paths(aside(), panel(int(1.2 / (WAVELENGTH / 2))), tx, rx, FREQUENCY)
    phases = [
        paths.coefficient
        * torch.polar(float64(1.0), -2 * math.pi * FREQUENCY * paths.delay)[:, None, None]
        for paths in (truth, found)
    ]
    # What the ends of the plate diffract remains: 0.021 rad.
    assert float((phases[1] - phases[0]).norm() / phases[0].norm()) < 0.025


def test_gain_of_a_focus_grows_with_the_square_of_the_number():
    tx, rx = [8.0, 0.0, 0.5], [9.0, 1.0, -0.5]
    power = []
    for count in (8, 16):
        focused = panel(count).focus(tx, rx, FREQUENCY)
        ends = float64([tx]), float64([rx])
        power.append(float(panel_response(aside(), focused, *ends, FREQUENCY).abs()) ** 2)
    assert power[1] / power[0] == pytest.approx(16.0, rel=1e-2)


def test_one_bit_costs_four_decibels():
    tx, rx = [2.0, 0.3, 0.5], [2.5, 1.0, -0.5]
    focused = panel(64).focus(tx, rx, FREQUENCY)
    levels = []
    for bits in (None, 1, 2):
        found = panel_response(
            aside(), replace(focused, bits=bits), float64([tx]), float64([rx]), FREQUENCY
        )
        levels.append(20 * math.log10(float(found.abs())))
    assert levels[0] - levels[1] == pytest.approx(3.92, abs=0.15)
    assert levels[0] - levels[2] == pytest.approx(0.91, abs=0.1)


def test_rounded_phases_pass_derivatives_straight_through():
    phase = torch.rand(4, 4, dtype=torch.float64).requires_grad_()
    rounded = panel(4, phase=phase, bits=1).response
    (slope,) = torch.autograd.grad(rounded.angle().sum(), phase)
    assert torch.allclose(slope, torch.ones_like(slope))


def test_the_reverse_path_is_the_path():
    tx, rx = float64([[2.0, 0.1, 0.2], [2.2, -1.0, 0.3]]), behind(5)
    chosen = panel(16).focus(tx[0], rx[0], FREQUENCY)
    there = panel_paths(screened(), chosen, tx, rx, FREQUENCY)
    back = panel_paths(screened(), chosen, rx, tx, FREQUENCY).reverse()
    assert len(there) == len(back) > 0
    assert torch.allclose(there.coefficient, back.coefficient, rtol=1e-10, atol=1e-20)
    assert torch.allclose(there.departure, back.departure)


def test_far_away_waves_are_plane():
    chosen = panel(12).focus([30.0, 5.0, 0.0], [40.0, -8.0, 3.0], FREQUENCY)
    tx, rx = float64([[30.0, 5.0, 0.0]]), behind(20) * 40.0
    exact, far = (
        panel_response(aside(), chosen, tx, rx, FREQUENCY, far_field=far) for far in (False, True)
    )
    assert float((far - exact).abs().max() / exact.abs().max()) < 0.02


def test_a_pattern_of_half_a_wavelength_takes_what_falls_on_it():
    # Straight ahead a gain of π is the aperture of a λ/2 cell.
    ends = float64([[5.0, 0.0, 0.0]]), float64([[6.0, 0.0, 0.0]])
    plain, shaped = (
        panel_response(aside(), panel(2, pattern=pattern), *ends, FREQUENCY)
        for pattern in (None, Cosine(math.pi / 2 - 1))
    )
    assert float((shaped / plain - 1).abs()) < 1e-4


def test_an_antenna_behind_gets_nothing():
    found = panel_paths(aside(), panel(4), [2.0, 0.0, 0.0], [-1.0, 0.3, 0.0], FREQUENCY)
    assert len(found) == 0


def test_lit_fractions_are_those_of_a_straight_edge():
    chosen, rx = replace(panel(32), position=float64([0.0, 0.02, 0.0])), behind(100)
    found = visible_fractions(screened(), rx, chosen.cells)
    edge = rx[:, 1] - rx[:, 1] * rx[:, 0] / (rx[:, 0] - 1)  # shadows of y > edge at x = 0
    truth = (edge[:, None] - chosen.cells.centers[:, 1]) / (WAVELENGTH / 2) + 0.5
    assert ((truth > 0) & (truth < 1)).sum() > 100
    assert float((found - truth.clamp(0, 1)).abs().max()) < 1e-9


def test_two_shadows_do_not_light_each_other():
    # The second screen's edge ends nothing: it lies in the shadow of the first.
    second = Object(plate(1.0, 4.0), PerfectConductor(), rigid(translation=[0.8, 0.53, 0.0]))
    both = Scene({**screened().objects, "second": second})
    rx = float64([[3.0, 0.0, 0.0]])
    cells = replace(panel(32), position=float64([0.0, 0.02, 0.0])).cells
    assert torch.equal(visible_fractions(both, rx, cells), visible_fractions(screened(), rx, cells))


@pytest.mark.parametrize("moved", ["position", "yaw", "blocker"])
def test_derivatives_hold_the_motion_of_shadows(moved: str):
    """§12: elements that go into the shadow; with fixed shadows the derivative is wrong."""
    rx, tx = behind(40), float64([[3.0, -0.5, 0.0]])

    def power(theta: Tensor, *, boundary: bool = True) -> Tensor:
        zero = torch.zeros_like(theta)
        chosen, scene = panel(24), screened(theta if moved == "blocker" else 0.0)
        if moved == "position":
            chosen = replace(chosen, position=torch.stack([zero, theta + 0.01, zero]))
        if moved == "yaw":
            c, s, one = theta.cos(), theta.sin(), torch.ones_like(theta)
            turn = torch.stack([c, -s, zero, s, c, zero, zero, zero, one]).view(3, 3)
            chosen = replace(chosen, axes=turn, position=float64([0.0, 0.01, 0.0]))
        chosen = chosen.focus([3.0, -0.5, 0.0], [2.0, 0.0, 0.0], FREQUENCY)
        found = panel_response(scene, chosen, tx, rx, FREQUENCY, boundary=boundary)
        return 1e6 * found.abs().square().sum()

    step = 1e-6
    with torch.no_grad():
        truth = float(power(float64(step)) - power(float64(-step))) / (2 * step)
    theta = float64(0.0).requires_grad_()
    (full,) = torch.autograd.grad(power(theta), theta)
    assert float(full) == pytest.approx(truth, rel=1e-5)
    still = power(theta, boundary=False)
    fixed = 0.0 if moved == "blocker" else float(torch.autograd.grad(still, theta)[0])
    assert abs(fixed - truth) > 0.1 * abs(truth)


def test_paths_add_up_coherently():
    tx, rx = [3.0, -1.0, 0.0], [[2.0, -0.4, 0.1], [2.5, -0.2, -0.2]]
    chosen = panel(16).focus(tx, rx[0], FREQUENCY)
    direct = trace_paths(screened(), tx, rx, FREQUENCY, depth=0)
    over = panel_paths(screened(), [chosen], tx, rx, FREQUENCY)
    total = frequency_response(direct + over, [FREQUENCY])
    parts = [frequency_response(paths, [FREQUENCY]) for paths in (direct, over)]
    assert torch.allclose(total, parts[0] + parts[1])
    assert {"metasurface"} == {("", "", "", "", "metasurface")[k] for k in over.kinds.ravel()}
    twice = panel_paths(screened(), [chosen, chosen], tx, rx, FREQUENCY)
    assert torch.allclose(frequency_response(twice, [FREQUENCY]), 2 * parts[1])


def test_a_radio_map_has_panels():
    tx, rx = (
        Transmitters(float64([[3.0, -1.0, 0.0]])),
        float64([[2.0, -0.4, 0.1], [2.5, -0.2, -0.2]]),
    )
    chosen = panel(16).focus([3.0, -1.0, 0.0], rx[0], FREQUENCY)
    for bandwidth in (0.0, None):
        maps = [
            RadioMap(
                ReceiverPoints(rx),
                PropagationSettings(FREQUENCY, bandwidth, depth=0, panels=p),
                "path_gain",
            )
            for p in ((), (chosen,))
        ]
        without, with_panel = (model.predict(screened(), tx, 0) for model in maps)
        assert float((with_panel - without).abs().max()) > 1e-3


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"phase": torch.zeros(0, 3).double()}, "at least one element"),
        ({"spacing": 0.0}, r"spacing of a metasurface \[m\] in \(0, inf\), got 0"),
        ({"amplitude": torch.ones(3, 3).double()}, "amplitudes of a metasurface"),
        ({"amplitude": -1.0}, "turn the phase"),
        ({"bits": 0}, "bits of a metasurface"),
        ({"bits": 9}, "at most 8 bits"),
    ],
)
def test_wrong_panels_are_refused(change: dict[str, object], words: str):
    with pytest.raises(InputError, match=words):
        panel(4, **change)


def test_axes_must_be_orthonormal():
    with pytest.raises(InputError, match="orthonormal columns"):
        replace(panel(2), axes=torch.ones_like(AXES))


def test_wrong_calls_are_refused():
    far = [2.0, 0.0, 0.0]
    with pytest.raises(InputError, match="at least one metasurface, got none"):
        panel_paths(aside(), [], far, far, FREQUENCY)
    with pytest.raises(InputError, match="got one on it; move it"):
        panel_paths(aside(), panel(4), far, [0.001, 0.001, 0.0], FREQUENCY)
    with pytest.raises(InputError, match="at least one row of rx places"):
        panel_paths(aside(), panel(4), far, torch.zeros(0, 3), FREQUENCY)
    with pytest.raises(InputError, match=r"frequency \[Hz\]"):
        panel_paths(aside(), panel(4), far, far, 0.0)


def test_cells_hold_what_panels_send_and_how_a_screen_moves_it():
    mast = Transmitters(float64([1.4, -0.6, 0.1]))
    corner, wide, high = float64([[2.0, -0.3, -0.2], [0.0, 0.6, 0.0], [0.0, 0.0, 0.4]])
    cell = MapPlane(corner, wide, high, (1, 1), CellSampling(points=25))
    reception = PropagationSettings(FREQUENCY, depth=0, panels=[panel(16)])

    def gain(shift: Tensor, reception: PropagationSettings) -> Tensor:
        return cell.link_statistics(screened(shift), mast, reception, 3).gain.sum()

    shift = float64(0.05)
    with_panel, without = (gain(shift, r) for r in (reception, replace(reception, panels=())))
    points = cell.sample_points(np.random.default_rng(np.random.SeedSequence([3, 1]))).flatten(0, 1)
    over = panel_paths(screened(shift), panel(16), mast.positions, points, FREQUENCY)
    assert float(with_panel - without) == pytest.approx(float(received_gain(over).mean()), rel=1e-9)
    alone = {how: gain(shift + way, reception) for how, way in (("up", 1e-5), ("down", -1e-5))}
    bare = {
        how: gain(shift + way, replace(reception, panels=()))
        for how, way in (("up", 1e-5), ("down", -1e-5))
    }
    truth = float(alone["up"] - bare["up"] - alone["down"] + bare["down"]) / 2e-5
    rates = [
        float(jvp(lambda x, r=r: gain(x, r), (shift,), (torch.ones_like(shift),))[1])
        for r in (reception, replace(reception, panels=()))
    ]
    assert rates[0] - rates[1] == pytest.approx(truth, rel=1e-3)
    assert truth != 0
