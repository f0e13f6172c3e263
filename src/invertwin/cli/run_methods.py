"""The ways to the derivative of one map, side by side: the gradient figure of the paper."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from invertwin.channel import Grid, Sampling, draw_speckle
from invertwin.cli import build
from invertwin.cli.figures import Panel, derivatives_picture
from invertwin.cli.pictures import Axes
from invertwin.cli.report import Table
from invertwin.cli.run_file import need
from invertwin.cli.schema import RunFile
from invertwin.inversion.gradcheck import Direction, GradientReport
from invertwin.peers.edge_sampling import edge_sampling_derivative
from invertwin.peers.music import MusicMap
from invertwin.peers.sionna import sionna_derivative, sionna_version
from invertwin.radar.radar import Radar
from invertwin.scene import Scene

NAMES = {
    "music_difference": "differences through MUSIC",
    "music_direct": "automatic, through MUSIC",
    "interior_only": "automatic, interior only",
    "edge_sampling": "edge sampling, strength only",
    "sionna_rt": "Sionna RT",
    "invertwin": "invertwin",
}
"""Keys of `methods` in metrics.json, and what reports call them."""

NOTE = (
    "relative L1: ‖g − g_FD‖₁ / ‖g_FD‖₁, g_FD the converged differences through the surrogate; 0 "
    "is best, and a derivative of zero has 1. MAE, unit maximum: mean absolute error per voxel of "
    "derivatives scaled to a largest absolute value of one. The paper gives 0.59, 0.63 and 0.69 "
    "without its normalisation, so that they cannot be compared with either column. MUSIC spectra "
    "have no unit of power: before relative L1 is taken, their derivatives are scaled by the "
    "factor that brings it lowest."
)
_NO_UNIT = ("music_difference", "music_direct")


@dataclass(frozen=True)
class Comparison:
    """What came out of :func:`compare`.

    Attributes:
        found: Per method, what metrics.json holds.
        picture: PNG.
    """

    found: dict[str, Any]
    picture: bytes


def compare(
    run: RunFile,
    scene: Scene,
    radar: Radar,
    grid: Grid,
    direction: Direction,
    step: float,
    report: GradientReport,
    say: Callable[[str], None],
) -> Comparison:
    """All methods on the scene of a gradient check that is done.

    Args:
        run: With a section `methods`.
        scene: Its scene.
        radar: Its radar.
        grid: Its bins.
        direction: Its θ.
        step: ε of its differences, which MUSIC's take too.
        report: The gradient check: the differences, ours, and the interior alone.
        say: Called with a line of progress.
    """
    settings = need(run, "methods", "the comparison of methods")
    surrogate = build.surrogate(run.surrogate)
    truth = report.difference
    say("MUSIC")
    music = MusicMap(
        radar,
        grid,
        draw_speckle(
            scene, radar.link(), Sampling(depth=1, points_per_m2=settings.density), run.seed
        ),
        settings.sources,
        tuple(settings.smoothing),
        run.seed,
    )
    maps: dict[str, Tensor | None] = {
        "music_difference": music.difference(scene, direction, step),
        "music_direct": music.derivative(scene, direction),
        "interior_only": report.interior_gradient,
    }
    say("edge sampling")
    maps["edge_sampling"] = edge_sampling_derivative(
        scene,
        radar,
        grid,
        direction,
        surrogate=surrogate,
        samples=settings.samples,
        edge_samples=settings.samples,
        seed=run.seed,
    )
    installed = sionna_version()
    maps["sionna_rt"] = None
    if installed is not None:
        say("Sionna RT")
        maps["sionna_rt"] = sionna_derivative(
            scene,
            radar,
            grid,
            direction,
            surrogate=surrogate,
            samples=settings.samples,
            seed=run.seed,
        )
    maps["invertwin"] = report.gradient
    found = {name: scores(maps[name], truth, fitted=name in _NO_UNIT) for name in NAMES}
    found["sionna_rt"] |= {"version": installed, "note": _of_sionna(maps["sionna_rt"])}
    panels = [
        Panel("differences through the surrogate (truth)", np.asarray(truth)),
        *(_panel(name, values) for name, values in maps.items()),
    ]
    axes = Axes(grid.ranges.numpy(), grid.u.numpy(), grid.v.numpy())
    return Comparison(found, derivatives_picture(panels, axes))


def scores(values: Tensor | None, truth: Tensor, *, fitted: bool) -> dict[str, Any]:
    """Both distances of a derivative from the truth; of none, none.

    Args:
        values: The derivative's map.
        truth: What it should be.
        fitted: Scale it first by the factor with the lowest relative L1.
    """
    if values is None:
        return {"relative_l1": None, "mae_unit_max": None}
    factor = best_factor(values, truth) if fitted else 1.0
    miss = (factor * values - truth).abs().sum() / truth.abs().sum()
    return {
        "relative_l1": float(miss),
        "mae_unit_max": float((_unit(values) - _unit(truth)).abs().mean()),
        "scale": factor,
    }


def best_factor(values: Tensor, truth: Tensor) -> float:
    """The s with the least Σ|s·values − truth|: a weighted median of truth / values."""
    used = values != 0
    if not bool(used.any()):
        return 1.0
    ratio, order = (truth[used] / values[used]).sort()
    weight = values[used].abs()[order].cumsum(0)
    return float(ratio[int((weight < 0.5 * weight[-1]).sum())])


def methods_table(name: str, found: Mapping[str, Any]) -> Table:
    """One row a method; what is not installed says so."""
    rows = [
        [title, found[key]["relative_l1"], found[key]["mae_unit_max"], found[key].get("note", "")]
        for key, title in NAMES.items()
    ]
    columns = ("method", "relative L1", "MAE, unit maximum", "")
    return Table(f"Ways to the derivative of {name}", columns, rows, NOTE)


def _unit(values: Tensor) -> Tensor:
    largest = values.abs().max()
    return values / largest if largest > 0 else values


def _panel(name: str, values: Tensor | None) -> Panel:
    title = NAMES[name] + (" (own scale)" if name in _NO_UNIT else "")
    if values is None:
        return Panel(title, "not installed")
    if not bool(torch.count_nonzero(values)):
        return Panel(title, "zero everywhere")
    return Panel(title, np.asarray(values), own_scale=name in _NO_UNIT)


def _of_sionna(values: Tensor | None) -> str:
    if values is None:
        return "not installed"
    if not bool(torch.count_nonzero(values)):
        return "zero: its solver detaches the places of its paths from the meshes"
    return ""
