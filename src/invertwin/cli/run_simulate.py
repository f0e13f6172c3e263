"""`invertwin simulate`: exact radar signals of a scene, saved as a capture."""

import math
import time

import numpy as np
import torch

from invertwin.capture import Capture
from invertwin.channel.paths import Grid
from invertwin.cli import build, pictures
from invertwin.cli.report import Again, Picture, Table, report_html
from invertwin.cli.run_file import need, to_toml
from invertwin.cli.runs import RunFolder
from invertwin.cli.schema import RunFile, SimulatedData
from invertwin.errors import InputError
from invertwin.radar.radar import Radar
from invertwin.radar.surrogate import Surrogate
from invertwin.scene import Scene
from invertwin.scene.files import save_mesh
from invertwin.simulation import Simulation, simulate

_SURROGATE_SAMPLES = 2_000_000
_LABELS = {
    "frames": "frames",
    "channels": "virtual channels",
    "paths": "paths",
    "bins": "bins of range, u, v",
    "peak_power_db": "strongest bin of a frame, received over sent [dB]",
    "peak_range_m": "strongest bin over all frames, range [m]",
    "peak_u": "strongest bin over all frames, u",
    "peak_v": "strongest bin over all frames, v",
    "correlation_with_surrogate": "correlation with the surrogate's map",
    "wall_seconds": "time of the exact simulation [s]",
}


def exact(run: RunFile, scene: Scene, radar: Radar, grid: Grid) -> Simulation:
    """The exact chain with the settings of the `[data]` table.

    Raises:
        InputError: The run file's data are measured, not simulated.
    """
    data = need(run, "data", "a simulation")
    if not isinstance(data, SimulatedData):
        raise InputError(
            f'data.kind: expected "simulated" to simulate a scene, got "{data.kind}"; '
            "give density and snr_db instead of a capture"
        )
    with torch.no_grad():
        return simulate(
            scene,
            radar,
            grid,
            seed=run.seed if data.seed is None else data.seed,
            samples=data.samples,
            density=data.density,
            snr_db=data.snr_db,
            noise_figure_db=data.noise_figure_db,
        )


def run_simulate(run: RunFile, folder: RunFolder) -> list[Table]:
    """Simulates the true scene of a run file, writes the folder, returns the tables to print."""
    begin = time.perf_counter()
    scene = build.true_scene(run)
    radar = build.radar(need(run, "radar", "simulate"))
    grid = build.grid(need(run, "grid", "simulate"), radar)
    found = exact(run, scene, radar, grid)
    seconds = time.perf_counter() - begin
    assert found.beat is not None
    assert found.paths is not None
    with torch.no_grad():
        smooth = simulate(
            scene, radar, grid, seed=run.seed, surrogate=Surrogate(), samples=_SURROGATE_SAMPLES
        ).spectrum
    Capture.from_beat(found.beat, radar).save(folder.file("capture.nc"))
    save_mesh(folder.file("twin.ply"), scene)
    metrics = {
        "task": "simulate",
        "frames": radar.frame_count,
        "channels": len(radar.virtual_positions),
        "paths": len(found.paths),
        "bins": list(grid.shape),
        **_peak(found.spectrum, grid),
        "correlation_with_surrogate": _correlation(found.spectrum, smooth),
        "wall_seconds": seconds,
    }
    folder.write_json("metrics.json", metrics)
    rows = [[label, metrics[key]] for key, label in _LABELS.items()]
    table = Table("Simulation", ["quantity", "value"], rows)
    drawing = pictures.Drawing(
        pictures.meshes_of(scene), sought=list(run.truth), radar=radar.positions.numpy()
    )
    axes = pictures.Axes(grid.ranges.numpy(), grid.u.numpy(), grid.v.numpy())
    maps = {"exact signal": found.spectrum.numpy(), "surrogate": smooth.numpy()}
    folder.write_bytes(
        "scene.png", pictures.scene_picture({"scene": drawing}, pictures.frame_of(radar))
    )
    folder.write_bytes("spectra.png", pictures.spectra_picture(maps, axes))
    shown = [
        Picture("Scene", (folder.path / "scene.png").read_bytes()),
        Picture(
            "Spectra",
            (folder.path / "spectra.png").read_bytes(),
            note="The surrogate is the mean of the exact spectrum over random phases.",
        ),
    ]
    title = run.title or "Simulation"
    status = f"{len(found.paths)} paths, {radar.frame_count} frames."
    again = Again("simulate run.toml", {"run.toml": to_toml(run)})
    folder.write_text("report.html", report_html(title, status, run.note, [table, *shown], again))
    return [table]


def _peak(spectrum: torch.Tensor, grid: Grid) -> dict[str, float | None]:
    """Where the power, summed over frames, is largest, and the largest of one frame in dB."""
    total = spectrum.sum(0)
    r, u, v = np.unravel_index(int(total.argmax()), total.shape)
    peak = float(spectrum.max())
    return {
        "peak_power_db": 10 * math.log10(peak) if peak > 0 else None,
        "peak_range_m": float(grid.ranges[r]),
        "peak_u": float(grid.u[u]),
        "peak_v": float(grid.v[v]),
    }


def _correlation(a: torch.Tensor, b: torch.Tensor) -> float:
    pair = torch.stack([a.double().flatten(), b.double().flatten()])
    return float(torch.corrcoef(pair)[0, 1])
