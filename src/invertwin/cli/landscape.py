"""Why the surrogate: the exact signal's loss beside the surrogate's, along a line."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from invertwin import plotting
from invertwin.capture import Capture
from invertwin.channel import Sampling, draw_speckle, trace_field
from invertwin.cli import build
from invertwin.cli.fits.problem import Problem, models_of
from invertwin.cli.run_file import need
from invertwin.cli.schema import RunFile, SimulatedData
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.inversion.starts import displaced
from invertwin.models import SurrogateMap
from invertwin.radar.radar import Radar
from invertwin.radar.range_profile import beat_signal
from invertwin.scene import AntennaArray, Scene


def landscape(problem: Problem) -> tuple[Figure, dict[str, Any]]:
    """The figure of the `[landscape]` table, and the local minima of every curve.

    For the exact signal one channel of one frame is enough to show the shape.
    """
    run, truth, sight = problem.run, problem.truth, problem.first
    table = need(run, "landscape", "the loss landscape")
    first, beat = sight.radar.frames([0]), sight.capture.beat[:1, :1, :1]
    fine = np.linspace(-table.exact_span, table.exact_span, table.exact_points)
    wide = np.linspace(-table.span, table.span, table.points)
    along = table.object, table.axis
    model = models_of(problem)[0]
    assert isinstance(model, SurrogateMap)
    models = {
        "surrogate, first widths": model,
        "surrogate, no extra width": model.narrowed(0.0),
    }
    with torch.no_grad():
        near, scenes = moved(truth, *along, fine), moved(truth, *along, wide)
        views = {"beat": lambda beat: beat}
        exact = exact_losses(run, truth, first, near, beat, views, _one_channel(first))["beat"]
        smooth = {
            name: (wide, smooth_losses(run, sight.radar, sight.capture, scenes, model))
            for name, model in models.items()
        }
    minima = {"exact": plotting.count_minima(exact)}
    minima |= {name: plotting.count_minima(losses) for name, (_, losses) in smooth.items()}
    figure = plotting.landscape((fine, exact), smooth, line_name(*along))
    return figure, {"local_minima": minima}


def moved(truth: Scene, name: str, axis: Sequence[float], offsets: Iterable[float]) -> list[Scene]:
    """Scenes in which one object is off the truth by each of the offsets [m] along an axis."""
    unit = torch.tensor(axis, dtype=torch.float64)
    moves = [offset * unit / unit.norm() for offset in offsets]
    return [truth.replace(name, pose=displaced(truth[name], move).pose) for move in moves]


def line_name(name: str, axis: Sequence[float]) -> str:
    """What moves and along what: x, y or z, or the direction's numbers."""
    used = [letter for letter, value in zip("xyz", axis, strict=True) if value]
    if len(used) == 1 and sum(axis) > 0:
        return f"{name} along {used[0]}"
    return f"{name} along ({', '.join(f'{value:g}' for value in axis)})"


def exact_losses(
    run: RunFile,
    truth: Scene,
    radar: Radar,
    scenes: Sequence[Scene],
    measured: Tensor,
    views: Mapping[str, Callable[[Tensor], Tensor]],
    seen: Radar | None = None,
) -> dict[str, np.ndarray]:
    """Relative squared errors of what is made of the exact beat signals of scenes, by view.

    Rough points are drawn on the true scene. What the phase centres of the radar, of one frame,
    see is what all channels see; `seen` chooses some of these.
    """
    data = need(run, "data", "the loss landscape")
    assert isinstance(data, SimulatedData)
    seed = run.seed if data.seed is None else data.seed
    sampling = Sampling(depth=1, samples=data.samples, points_per_m2=data.density, boundary=False)
    link, channels = radar.link(), seen or radar
    speckle = draw_speckle(truth, link, sampling, seed)
    centers = link.tx[0], link.rx[0]
    own = channels.link()
    targets = {name: view(measured) for name, view in views.items()}
    rows = []
    for scene in scenes:
        paths = trace_field(scene, link, sampling=sampling, seed=seed, speckle=speckle)
        # What the whole array's centre sees, at the delay to the centre of the channels.
        legs = [
            (paths.first - tx).norm(dim=1) + (paths.last - rx).norm(dim=1)
            for tx, rx in (centers, (own.tx[0], own.rx[0]))
        ]
        delay = paths.delay + (legs[1] - legs[0]) / SPEED_OF_LIGHT
        signal = beat_signal(replace(paths, delay=delay), channels)
        rows.append([_relative(view(signal), targets[name]) for name, view in views.items()])
    return {
        name: np.array(losses) for name, losses in zip(views, zip(*rows, strict=True), strict=True)
    }


def _relative(values: Tensor, target: Tensor) -> float:
    return float((values - target).abs().square().mean() / target.abs().square().mean())


def _one_channel(radar: Radar) -> Radar:
    def single(array: AntennaArray) -> AntennaArray:
        return replace(array, positions=array.positions[:1])

    return replace(
        radar,
        transmitters=single(radar.transmitters),
        receivers=single(radar.receivers),
        shared_visibility=True,
    )


def smooth_losses(
    run: RunFile, radar: Radar, capture: Capture, scenes: Sequence[Scene], model: SurrogateMap
) -> np.ndarray:
    """The `[loss]` of the surrogate's maps of scenes against the measured spectrum."""
    measured = model.blurred(model.observe(capture), radar)
    loss = build.loss(run.loss)
    # The same points of the surfaces in every scene, or steps as fine as these would show the
    # samples.
    middle = scenes[len(scenes) // 2]
    fixed = model.for_differences(middle, radar, model.sampling.samples, "area")
    return np.array([float(loss(fixed.predict(s, radar, run.seed), measured)) for s in scenes])
