"""Why the surrogate: the exact signal's loss beside the surrogate's, along a line."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from invertwin.capture import Capture
from invertwin.channel.paths import Grid
from invertwin.channel.tracer import rough_points, trace_field
from invertwin.cli import build, pictures
from invertwin.cli.run_file import need
from invertwin.cli.schema import RunFile, SimulatedData
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.radar.radar import Radar
from invertwin.radar.range_profile import beat_signal
from invertwin.radar.surrogate import Surrogate, surrogate_spectrum
from invertwin.scene import AntennaArray, Scene


def landscape(
    run: RunFile, truth: Scene, radar: Radar, grid: Grid, capture: Capture
) -> tuple[bytes, dict[str, Any]]:
    """The picture and the numbers of the `[landscape]` table.

    For the exact signal one channel of one frame is enough to show the shape.

    Returns:
        PNG bytes; and the number of local minima of every curve.
    """
    table = need(run, "landscape", "the loss landscape")
    axis = torch.tensor(table.axis, dtype=torch.float64)
    axis = axis / axis.norm()
    still = torch.zeros(3, dtype=torch.float64)

    def moved(offset: float) -> Scene:
        return build.displaced(truth, table.object, offset * axis, still)

    with torch.no_grad():
        x = np.linspace(-table.exact_span, table.exact_span, table.exact_points)
        exact = (x, _exact(run, truth, radar, capture, [moved(offset) for offset in x]))
        x = np.linspace(-table.span, table.span, table.points)
        scenes = [moved(offset) for offset in x]
        wide = build.surrogate(run.surrogate)
        sharp = replace(wide, range_width=0.0, angle_width=0.0)
        kernels = {"surrogate, first widths": wide, "surrogate, no extra width": sharp}
        smooth = {
            name: (x, _smooth(run, radar, grid, capture, scenes, kernel))
            for name, kernel in kernels.items()
        }
    counts = {name: pictures.count_minima(losses) for name, (_, losses) in smooth.items()}
    minima = {"exact": pictures.count_minima(exact[1]), **counts}
    along = f"{table.object} along {_name(table.axis)}"
    return pictures.landscape_picture(exact, smooth, along), {"local_minima": minima}


def _name(axis: list[float]) -> str:
    """x, y or z, or the direction's numbers."""
    used = [name for name, value in zip("xyz", axis, strict=True) if value]
    if len(used) == 1 and sum(axis) > 0:
        return used[0]
    return f"({', '.join(f'{value:g}' for value in axis)})"


def _exact(
    run: RunFile, truth: Scene, radar: Radar, capture: Capture, scenes: list[Scene]
) -> np.ndarray:
    """Relative squared error of one channel's beat signal against the measured one."""
    data = need(run, "data", "the loss landscape")
    assert isinstance(data, SimulatedData)
    seed = run.seed if data.seed is None else data.seed
    points = rough_points(truth, data.density, seed)

    def single(array: AntennaArray) -> AntennaArray:
        return replace(array, positions=array.positions[:1])

    first = radar.frames([0])
    link = first.link()
    one = replace(
        first,
        transmitters=single(radar.transmitters),
        receivers=single(radar.receivers),
        shared_visibility=True,
    )
    tx, rx = (places[0, 0] for places in one.elements())
    measured = capture.beat[:1, :1, :1]

    def loss(scene: Scene) -> float:
        paths = trace_field(
            scene,
            link,
            samples=data.samples,
            points=points,
            seed=seed,
            boundary=False,
        )
        # What the whole array's centre sees, at the delay of the one channel.
        legs = (paths.first - tx).norm(dim=1) + (paths.last - rx).norm(dim=1)
        signal = beat_signal(replace(paths, delay=legs / SPEED_OF_LIGHT), one)
        miss = signal - measured
        return float(miss.abs().square().mean() / measured.abs().square().mean())

    return np.array([loss(scene) for scene in scenes])


def _smooth(
    run: RunFile,
    radar: Radar,
    grid: Grid,
    capture: Capture,
    scenes: list[Scene],
    kernel: Surrogate,
) -> np.ndarray:
    settings = need(run, "reconstruct", "the loss landscape")
    measured = kernel.blur(capture.spectrum(grid).float(), radar, grid)
    loss = build.loss(run.loss)

    def at(scene: Scene) -> float:
        simulated = surrogate_spectrum(
            scene,
            radar,
            grid,
            kernel,
            samples=settings.samples,
            boundary_samples=0,
            seed=run.seed,
            depth=settings.depth,
        )
        return float(loss(simulated, measured))

    return np.array([at(scene) for scene in scenes])
