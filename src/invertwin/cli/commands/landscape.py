"""Loss landscapes: the exact signal's loss beside the surrogate's, along a line."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from rich.console import Console

from invertwin import plotting
from invertwin.cli.fits.problem import Problem
from invertwin.cli.run_file import require_section
from invertwin.cli.schema import RunFile, SimulatedData, build
from invertwin.cli.terminal import show_progress
from invertwin.inversion import Observation
from invertwin.inversion.gradcheck.lines import ParameterLine, evaluate_losses, make_line
from invertwin.inversion.loss import relative_error
from invertwin.models.radar import BeatMap
from invertwin.runtime.progress import track
from invertwin.scene import Scene, Translation


def plot_landscape(problem: Problem, console: Console) -> tuple[Figure, dict[str, Any]]:
    """The figure of the `[landscape]` table, and the local minima of every curve.

    For the exact signal one channel of one frame is enough to show the shape.
    """
    run, truth, item = problem.run, problem.truth, problem.first_sensor
    table = require_section(run, "landscape", "the loss landscape")
    line, along = make_object_line(truth, table.object, table.axis)
    fine = np.linspace(-table.exact_span, table.exact_span, table.exact_points)
    wide = np.linspace(-table.span, table.span, table.points)
    model, first = BeatMap(item.grid, channels=(slice(1), slice(1))), item.sensor.frames([0])
    beat = Observation(model, item.recording.beat[:1, :1, :1], sensor=first, loss=relative_error)
    with show_progress(console):
        exact = evaluate_exact_losses(run, line, fine, beat)
    model, loss = problem.kind.models(problem)[0], build.build_loss(run)
    smooth = {}
    for name, share in (("initial blur", 1.0), ("no blur", 0.0)):
        seen = Observation(model.scale_blur(share), item.recording, sensor=item.sensor, loss=loss)
        with show_progress(console):
            offsets = track(wide.tolist(), f"loss landscape, {name}")
            losses = evaluate_losses(line, offsets, seen, seed=run.seed).numpy()
        smooth[f"surrogate, {name}"] = wide, losses
    minima = {"exact": exact, **{name: losses for name, (_, losses) in smooth.items()}}
    counts = {name: plotting.count_minima(losses) for name, losses in minima.items()}
    return plotting.landscape((fine, exact), smooth, along), {"local_minima": counts}


def make_object_line(truth: Scene, name: str, axis: Sequence[float]) -> tuple[ParameterLine, str]:
    """Return the line on which one object is θ [m] off the truth, and its label in figures."""
    unit = torch.tensor(axis, dtype=torch.float64)
    used = [letter for letter, value in zip("xyz", axis, strict=True) if value]
    way = f"({', '.join(f'{value:g}' for value in axis)})"
    along = f"{name} along {used[0] if len(used) == 1 and sum(axis) > 0 else way}"
    return make_line(Translation(name), unit / unit.norm(), truth), along


def evaluate_exact_losses(
    run: RunFile, line: ParameterLine, offsets: np.ndarray, observation: Observation
) -> np.ndarray:
    """Losses of exact signals along a line, with the rough points of the simulated data."""
    data = require_section(run, "data", "the loss landscape")
    assert isinstance(data, SimulatedData)
    drawn = {"samples": data.samples, "points_per_m2": data.points_per_m2, "boundary": False}
    observation = replace(observation, model=observation.model.with_sampling(depth=1, **drawn))
    seed = run.seed if data.seed is None else data.seed
    steps = track(offsets.tolist(), "loss landscape, exact signal")
    return evaluate_losses(line, steps, observation, seed=seed).numpy()
