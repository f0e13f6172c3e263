"""The cells of the capability table for paths of two bounces, without paths of one bounce."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from torch import Tensor

from gradients.test_capabilities import (
    MOVES,
    ROUGH,
    Found,
    bias_case,
    clock,
    power_radar,
    pushed,
    selected,
)
from invertwin.channel import Sampling, deposit_power
from invertwin.radar import Surrogate
from invertwin.scene import Scene, plate
from scenes import relative, thing

SAMPLES, MOST = 1_000_000, 24
IN_THE_ROOM = {"vertices", "radar position", "clock offset"}
MATERIALS = {
    "permittivity", "conductivity", "diffuse fraction", "lobe width", "thickness", "roughness",
    "scattering coefficient", "depolarisation",
}  # fmt: skip


def alcove() -> Scene:
    """A wall and a side that see each other, past a plate."""
    return Scene(
        {
            "wall": thing(plate(0.8, 0.6), (1.9, 0.15, 0.0), (0.0, 0.0, 0.3), ROUGH),
            "side": thing(plate(0.8, 0.6), (1.5, -0.5, 0.0), (0.0, 0.0, -1.1), ROUGH),
            "occluder": thing(plate(0.25, 0.2), (1.6, -0.12, 0.02), (0.0, 0.0, -0.4), ROUGH),
        }
    )


def room() -> Scene:
    """A wall and a floor, and a plate between them: more shadows, wider ones."""
    return Scene(
        {
            "wall": thing(plate(2.4, 2.4), (2.5, 0.0, 0.0), material=ROUGH),
            "floor": thing(plate(2.4, 2.4), (1.6, 0.0, -1.0), (0.0, math.pi / 2, 0.0), ROUGH),
            "occluder": thing(plate(0.6, 0.6), (1.8, 0.25, -0.4), material=ROUGH),
        }
    )


def converged(draw: Callable[[int], Tensor], noise: float) -> tuple[Tensor, float]:
    """The mean over seeds once its standard error is small enough, and that error (L1)."""
    drawn: list[Tensor] = []
    reached = math.inf
    while len(drawn) < 4 or (len(drawn) < MOST and reached > noise):
        drawn.append(draw(1_000 * len(drawn)))
        if len(drawn) > 1:
            both = torch.stack(drawn)
            error = both.std(0) / math.sqrt(len(drawn))
            reached = float(error.sum() / both.mean(0).abs().sum().clamp_min(1e-300))
    return torch.stack(drawn).mean(0), reached


@cache
def bounces_case(parameter: str) -> tuple[Found, Tensor]:
    """Derivatives, and the one without the shadows that surfaces cast on each other."""
    radar, moves = clock() if parameter == "clock offset" else (power_radar(), MOVES[parameter])
    first = replace(radar.receivers, positions=radar.receivers.positions[:1] * 0)
    radar = replace(radar, receivers=first)
    scene, kernels = alcove(), Surrogate("gaussian", range_width=1.5)
    grid, frames = radar.grid(1.0, 2.9, oversample=1), radar.frame_count
    step = 0.1 if parameter in MATERIALS else 2e-2
    if parameter == "thickness":  # a tenth would be half a fringe of the sheet
        step = 5e-3
    if parameter in IN_THE_ROOM:
        scene, kernels, step = room(), Surrogate("gaussian", range_width=2.0), 3e-2
        grid = radar.grid(0.9, 4.2, oversample=1)

    def value(
        theta: Tensor, seed: int, edges: int, reference: Any = None, **options: Any
    ) -> Tensor:
        moved, seen = moves(scene, radar, theta)
        two, one = (
            deposit_power(
                moved,
                seen.link(),
                grid,
                sampling=Sampling(
                    depth=depth,
                    samples=SAMPLES * frames,
                    boundary_samples=edges * frames,
                    **options,
                ),
                seed=seed,
                reference=reference,
            ).double()
            for depth in (2, 1)
        )
        return kernels.shape(two - one, seen, grid)

    def pair(seed: int) -> Tensor:
        ends = [
            value(
                torch.tensor(sign * step).double(), seed, 0,
                boundary=False, reference=(scene, radar.link()),
            )
            for sign in (1, -1)
        ]  # fmt: skip
        return (ends[0] - ends[1]) / (2 * step)

    def derivative(noise: float, edges: int, **options: Any) -> Tensor:
        return converged(
            lambda seed: pushed(lambda theta: value(theta, 7 + seed, edges, **options)), noise
        )[0]

    with torch.no_grad():
        truth, noise = converged(pair, 0.02)
        full = derivative(0.015, SAMPLES)
        interior = derivative(0.05, 0, boundary=False)
        outer = derivative(0.05, SAMPLES, interior_edges=False)
    return Found(full, interior, truth, noise), outer


@pytest.mark.parametrize(("parameter", "mechanism"), selected("supported", bounces=True))
def test_supported(parameter, mechanism):
    if parameter == "range bias":
        found = bias_case(depth=2)
        assert relative(found.full, found.truth) < 0.03
        return
    found, outer = bounces_case(parameter)
    assert found.noise < 0.03
    assert relative(found.full, found.truth) < 0.05
    if mechanism.endswith("boundary"):
        assert relative(found.interior, found.truth) > 3 * relative(found.full, found.truth)
    if mechanism.endswith("boundary") and not parameter.startswith(("radar", "clock")):
        assert relative(outer, found.truth) > relative(found.full, found.truth)


@pytest.mark.parametrize(("parameter", "mechanism"), selected("zero", bounces=True))
def test_zero(parameter, mechanism):
    assert mechanism == "bounces boundary"
    if parameter == "range bias":
        found = bias_case(depth=2)
        assert relative(found.full, found.interior) < 1e-5
        return
    scene, radar = alcove(), power_radar()
    grid = radar.grid(1.0, 2.9, 0.6, oversample=1)

    def value(theta: Tensor, boundary: bool) -> Tensor:
        moved, seen = MOVES[parameter](scene, radar, theta)
        edges = 20_000 if boundary else 0
        drawn = Sampling(depth=3, samples=50_000, boundary_samples=edges, boundary=boundary)
        return deposit_power(moved, seen.link(), grid, sampling=drawn, seed=1).double()

    with torch.no_grad():
        both = [pushed(lambda theta, on=on: value(theta, on)) for on in (True, False)]
    assert relative(both[0], both[1]) < 1e-5
