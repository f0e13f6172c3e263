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
from invertwin.channel import Grid, deposit_power, rough_points, trace_field
from invertwin.cli import build
from invertwin.cli.run_file import need
from invertwin.cli.schema import RunFile, SimulatedData
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.radar.radar import Radar
from invertwin.radar.range_profile import beat_signal
from invertwin.radar.surrogate import Surrogate
from invertwin.scene import AntennaArray, Scene


def landscape(
    run: RunFile, truth: Scene, radar: Radar, grid: Grid, capture: Capture
) -> tuple[Figure, dict[str, Any]]:
    """The figure and the numbers of the `[landscape]` table.

    For the exact signal one channel of one frame is enough to show the shape.

    Returns:
        The figure; and the number of local minima of every curve.
    """
    table = need(run, "landscape", "the loss landscape")
    settings = need(run, "reconstruct", "the loss landscape")
    samples, depth = settings.samples, settings.depth
    with torch.no_grad():
        x = np.linspace(-table.exact_span, table.exact_span, table.exact_points)
        first = radar.frames([0])
        losses = exact_losses(
            run,
            truth,
            first,
            moved(truth, table.object, table.axis, x),
            capture.beat[:1, :1, :1],
            {"beat": lambda beat: beat},
            _one_channel(first),
        )
        exact = (x, losses["beat"])
        x = np.linspace(-table.span, table.span, table.points)
        scenes = moved(truth, table.object, table.axis, x)
        wide = build.surrogate(run.surrogate)
        sharp = replace(wide, range_width=0.0, angle_width=0.0)
        kernels = {"surrogate, first widths": wide, "surrogate, no extra width": sharp}
        smooth = {
            name: (x, smooth_losses(run, radar, grid, capture, scenes, kernel, samples, depth))
            for name, kernel in kernels.items()
        }
    counts = {name: plotting.count_minima(losses) for name, (_, losses) in smooth.items()}
    minima = {"exact": plotting.count_minima(exact[1]), **counts}
    along = line_name(table.object, table.axis)
    return plotting.landscape(exact, smooth, along), {"local_minima": minima}


def moved(truth: Scene, name: str, axis: Sequence[float], offsets: Iterable[float]) -> list[Scene]:
    """Scenes in which one object is off the truth by each of the offsets [m] along an axis."""
    unit = torch.tensor(axis, dtype=torch.float64)
    unit, still = unit / unit.norm(), torch.zeros(3, dtype=torch.float64)
    return [build.displaced(truth, name, offset * unit, still) for offset in offsets]


def line_name(name: str, axis: Sequence[float]) -> str:
    """What moves and along what: x, y or z, or the direction's numbers."""
    return f"{name} along {_axis_name(axis)}"


def _axis_name(axis: Sequence[float]) -> str:
    used = [name for name, value in zip("xyz", axis, strict=True) if value]
    if len(used) == 1 and sum(axis) > 0:
        return used[0]
    return f"({', '.join(f'{value:g}' for value in axis)})"


def exact_losses(
    run: RunFile,
    truth: Scene,
    radar: Radar,
    scenes: Sequence[Scene],
    measured: Tensor,
    views: Mapping[str, Callable[[Tensor], Tensor]],
    seen: Radar | None = None,
) -> dict[str, np.ndarray]:
    """Relative squared errors of what is made of the exact beat signals of scenes.

    Args:
        run: Its `[data]` table says how signals are simulated.
        truth: Where the rough points are drawn.
        radar: Of one frame; what its phase centres see is what all channels see.
        scenes: Along a line.
        measured: Beat signal to compare with.
        views: What is compared, of a beat signal.
        seen: Only these channels of the radar.

    Returns:
        A loss for each scene, by view.
    """
    data = need(run, "data", "the loss landscape")
    assert isinstance(data, SimulatedData)
    seed = run.seed if data.seed is None else data.seed
    points = rough_points(truth, data.density, seed)
    link, channels = radar.link(), seen or radar
    centers = link.tx[0], link.rx[0]
    own = channels.link()
    targets = {name: view(measured) for name, view in views.items()}
    rows = []
    for scene in scenes:
        paths = trace_field(
            scene,
            link,
            samples=data.samples,
            points=points,
            seed=seed,
            boundary=False,
        )
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
    run: RunFile,
    radar: Radar,
    grid: Grid,
    capture: Capture,
    scenes: Sequence[Scene],
    kernel: Surrogate,
    samples: int,
    depth: int,
) -> np.ndarray:
    """The `[loss]` of the surrogate's maps of scenes against the measured spectrum."""
    measured = kernel.blur(capture.spectrum(grid).float(), radar, grid)
    loss = build.loss(run.loss)
    link = radar.link()

    def at(scene: Scene) -> float:
        # The same points of the surfaces in every scene, or steps as fine as these would show
        # the samples.
        power = deposit_power(
            scene,
            link,
            grid,
            samples=samples,
            boundary_samples=0,
            seed=run.seed,
            depth=depth,
            sampling="area",
            reference=(scenes[len(scenes) // 2], link),
        )
        return float(loss(kernel.shape(power, radar, grid), measured))

    return np.array([at(scene) for scene in scenes])
