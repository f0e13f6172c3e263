"""The ways to the derivative of one map, side by side: the gradient figure of the paper."""

from collections.abc import Mapping
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from invertwin.channel import Sampling, draw_speckle
from invertwin.cli.commands.gradcheck import GradcheckOutcome
from invertwin.cli.report import ReportTable
from invertwin.cli.schema import build
from invertwin_studies.figures import Derivative, derivatives
from invertwin_studies.peers.edge_sampling import edge_sampling_derivative
from invertwin_studies.peers.music import MusicMap
from invertwin_studies.peers.sionna import sionna_derivative, sionna_version
from invertwin_studies.sections import Methods

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


def compare(settings: Methods, checked: GradcheckOutcome) -> tuple[dict[str, Any], Figure]:
    """All methods on the scene of a gradient check that is done.

    Args:
        settings: Of the methods.
        checked: The gradient check; MUSIC's differences take its step, too.

    Returns:
        Per method, what metrics.json holds; and the figure of all derivatives.
    """
    run, scene, radar, grid = checked.run, checked.scene, checked.radar, checked.grid
    direction, report, say = checked.apply_theta, checked.report, checked.say
    surrogate = build.build_section(run, "surrogate")
    truth = report.difference
    say("MUSIC")
    music = MusicMap(
        radar,
        grid,
        draw_speckle(
            scene, radar.link(), Sampling(depth=1, points_per_m2=settings.points_per_m2), run.seed
        ),
        settings.sources,
        (settings.smoothing[0], settings.smoothing[1]),
        run.seed,
    )
    maps: dict[str, Tensor | None] = {
        "music_difference": music.difference(scene, direction, checked.step),
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
    shown = [
        Derivative("differences through the surrogate (truth)", truth),
        *(_shown(name, values) for name, values in maps.items()),
    ]
    return found, derivatives(shown, grid)


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
    """The s with the least Σ|s·values − truth|: a weighted median of truth / values.

    Args:
        values: A map.
        truth: What it should be in proportion to.
    """
    used = values != 0
    if not bool(used.any()):
        return 1.0
    ratio, order = (truth[used] / values[used]).sort()
    weight = values[used].abs()[order].cumsum(0)
    return float(ratio[int((weight < 0.5 * weight[-1]).sum())])


def methods_table(name: str, found: Mapping[str, Any]) -> ReportTable:
    """One row a method; what is not installed says so.

    Args:
        name: Of the gradient check.
        found: What `compare` found, by method.
    """
    rows = [
        [title, found[key]["relative_l1"], found[key]["mae_unit_max"], found[key].get("note", "")]
        for key, title in NAMES.items()
    ]
    columns = ("method", "relative L1", "MAE, unit maximum", "")
    return ReportTable(f"Ways to the derivative of {name}", columns, rows, NOTE)


def _unit(values: Tensor) -> Tensor:
    largest = values.abs().max()
    return values / largest if largest > 0 else values


def _shown(name: str, values: Tensor | None) -> Derivative:
    title = NAMES[name] + (" (own scale)" if name in _NO_UNIT else "")
    if values is None:
        return Derivative(title, "not installed")
    if not bool(torch.count_nonzero(values)):
        return Derivative(title, "zero everywhere")
    return Derivative(title, values, own_scale=name in _NO_UNIT)


def _of_sionna(values: Tensor | None) -> str:
    if values is None:
        return "not installed"
    if not bool(torch.count_nonzero(values)):
        return "zero: its solver detaches the places of its paths from the meshes"
    return ""
