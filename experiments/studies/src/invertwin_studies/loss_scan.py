"""`invertwin loss-scan`: losses along a line, the paper's figure of periodic local minima."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from invertwin.capture import Capture
from invertwin.channel import Grid, Sampling
from invertwin.cli.commands.landscape import evaluate_exact_losses, make_object_line
from invertwin.cli.estimate import SensorSetup, require_resources
from invertwin.cli.exact_signals import simulate_exact
from invertwin.cli.report import ReportTable, save_picture, write_report
from invertwin.cli.run_file import require_section
from invertwin.cli.schema import RunFile, build
from invertwin.errors import InputError
from invertwin.inversion import Observation
from invertwin.inversion.gradcheck.lines import ParameterLine, evaluate_losses
from invertwin.inversion.loss import relative_error
from invertwin.models.radar import BeatMap, SurrogateMap
from invertwin.radar.processing.direction import music
from invertwin.radar.radar import Radar
from invertwin.radar.signal.range_profile import range_profile
from invertwin.storage.run_folder import RunFolder
from invertwin_studies.figures import Curve, deep_minima, scan
from invertwin_studies.sections import LossScan

TITLES = {
    "beat": "raw beat signal",
    "range_profile": "range profile (FFT)",
    "music": "MUSIC spectrum",
    "surrogate": "surrogate",
}
"""Keys of the metrics, and what reports call them."""

_NOTE = (
    "The loss when one object is moved off its true place, all else true. Beat signals, complex "
    "range profiles and MUSIC spectra: relative squared error, of exact signals against the data "
    "of the first frame, with the same rough points. Surrogate: the loss of the run file, against "
    "the spectra of all frames of the same data. A minimum counts if it is deeper than a "
    "thousandth of the curve's span; the true place counts as one. Wavelengths are those of "
    "displacement: an echo's path changes by up to two of them for one."
)


def run_loss_scan(run: RunFile, folder: RunFolder) -> list[ReportTable]:
    """Scan the line of a run file, write the folder, and return the table to print.

    Args:
        run: With `[loss_scan]`.
        folder: Of the run.
    """
    begin = time.perf_counter()
    settings: LossScan = require_section(run, "loss_scan", "loss-scan")
    truth = build.true_scene(run)
    radar = build.radar(require_section(run, "radar", "loss-scan"))
    grid = build.grid(require_section(run, "grid", "loss-scan"), radar)
    depth = getattr(require_section(run, "data", "loss-scan"), "depth", 1)
    if run.surrogate.exact:
        raise InputError(
            "surrogate.exact: expected a smooth map beside the exact signals, got no surrogate; "
            "remove it"
        )
    if depth > 1:
        raise InputError(f"data.depth: expected 1 for loss-scan, got {depth}; set depth = 1")
    require_resources(run, truth, {"": SensorSetup(run, radar, grid)})
    found = simulate_exact(run, truth, radar, grid)
    line, along = make_object_line(truth, settings.object, settings.axis)
    near, wide = _losses(run, settings, line, radar, grid, found.beat)
    wavelengths = 2 * settings.span / radar.waveform.wavelength
    minima = {name: deep_minima(losses) for name, (_, losses) in near.items()}
    metrics: dict[str, Any] = {
        "task": "loss-scan",
        "wavelength_m": radar.waveform.wavelength,
        "span_wavelengths": wavelengths,
        "minima": minima,
        "minima_per_wavelength": {name: n / wavelengths for name, n in minima.items()},
        "minima_wide": deep_minima(wide[1]),
        "lowest_m": {name: _lowest(curve) for name, curve in near.items()},
        "wall_seconds": time.perf_counter() - begin,
    }
    figure = scan({TITLES[name]: curve for name, curve in near.items()}, wide, along)
    drawn = save_picture(folder, "losses", figure, "Loss against displacement")
    title = run.title or "Losses along a line"
    status = f"{along}, {2 * settings.span:g} m in {settings.points} steps."
    parts = [_table(metrics, along), drawn]
    return write_report(folder, metrics, title, status, parts, again="loss-scan", note=run.note)


def _losses(
    run: RunFile,
    settings: LossScan,
    line: ParameterLine,
    radar: Radar,
    grid: Grid,
    measured: Tensor,
) -> tuple[dict[str, Curve], Curve]:
    """The four curves near the truth, and the surrogate's farther away."""
    capture = Capture.from_beat(measured, radar)
    sampling = Sampling(depth=1, samples=settings.samples)
    model = SurrogateMap(grid, build.build_section(run, "surrogate"), sampling)
    smooth = Observation(model, capture, sensor=radar, loss=build.build_loss(run))
    first = radar.frames([0])
    views = _views(settings, first, grid)

    targets = [view(measured[:1]) for view in views.values()]

    def errors(beat: Tensor, _: Tensor) -> Tensor:
        pairs = zip(views.values(), targets, strict=True)
        return torch.stack([relative_error(view(beat), target) for view, target in pairs])

    x = np.linspace(-settings.span, settings.span, settings.points)
    far = np.linspace(-settings.wide_span, settings.wide_span, settings.wide_points)
    exact = evaluate_exact_losses(
        run, line, x, Observation(BeatMap(grid), measured[:1], sensor=first, loss=errors)
    )
    near = {name: (x, exact[:, k]) for k, name in enumerate(views)}
    near["surrogate"] = (x, evaluate_losses(line, x, smooth, seed=run.seed).numpy())
    return near, (far, evaluate_losses(line, far, smooth, seed=run.seed).numpy())


def _views(settings: LossScan, radar: Radar, grid: Grid) -> dict[str, Callable[[Tensor], Tensor]]:
    """What is compared, of a beat signal."""

    def profile(beat: Tensor) -> Tensor:
        return range_profile(beat, radar, grid)

    def spectrum(beat: Tensor) -> Tensor:
        return music(
            profile(beat)[:, None],
            radar,
            grid,
            sources=settings.sources,
            smoothing=(settings.smoothing[0], settings.smoothing[1]),
            forward_backward=True,
        )

    return {"beat": lambda beat: beat, "range_profile": profile, "music": spectrum}


def _lowest(curve: Curve) -> float:
    """Where the loss is lowest [m]."""
    return float(curve[0][np.argmin(curve[1])])


def _table(metrics: dict[str, Any], along: str) -> ReportTable:
    rows = [
        [
            title,
            metrics["minima"][name],
            metrics["minima_per_wavelength"][name],
            1e3 * metrics["lowest_m"][name],
        ]
        for name, title in TITLES.items()
    ]
    columns = ("loss of", "local minima", "per wavelength", "lowest at [mm]")
    wavelength = 1e3 * metrics["wavelength_m"]
    title = (
        f"Local minima: {along}, over {metrics['span_wavelengths']:.3g} wavelengths of "
        f"{wavelength:.3g} mm"
    )
    return ReportTable(title, columns, rows, _NOTE)
