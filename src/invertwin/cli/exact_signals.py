"""Exact signals with the settings of a run file: data of simulations and of fits of them."""

import warnings
from typing import Any

import torch

from invertwin.channel import Grid, Sampling
from invertwin.cli.run_file import prefix_errors, require_section
from invertwin.cli.schema import RunFile, SimulatedData, sensors
from invertwin.cli.schema.motion_tables import build_moving_scene, refuse_motion
from invertwin.errors import PhysicsWarning
from invertwin.radar import Chirps, Radar
from invertwin.refusals import refusal, refusal_text
from invertwin.scene import MovingScene, Scene
from invertwin.simulation import Simulation, simulate, simulate_chirps

_INSTANTS = 9  # of a frame, at which range rates are compared with their limit


def simulate_exact(run: RunFile, scene: Scene, radar: Radar, grid: Grid) -> Simulation:
    """Exact signals with the settings of the `[data]` table.

    Raises:
        InputError: The run file's data are measured, not simulated.
    """
    data = require_simulated_data(run)
    refuse_motion(run)
    front = None if run.impairments is None else sensors.impairments(run.impairments, data)
    noise: Any = {} if front else {"snr_db": data.snr_db, "noise_figure_db": data.noise_figure_db}
    how = _settings(run, scene, data.depth) | noise
    with torch.no_grad():
        return simulate(scene, radar, grid, impairments=front, **how)


def simulate_chirp_beats(run: RunFile, scene: Scene, radar: Radar, chirps: Chirps) -> torch.Tensor:
    """Exact beat signals of every chirp with the settings of `[data]` and `[chirps]`."""
    data = require_simulated_data(run)
    front = sensors.impairments(run.impairments, data)
    table = require_section(run, "chirps", "several ramps a frame")
    depth = data.depth if data.mirrors else 1
    moving, how = build_moving_scene(run, scene), _settings(run, scene, depth)
    warn_if_aliased(moving, radar, chirps)
    how |= {"retrace": table.retrace, "visibility_every": table.visibility_every}
    with prefix_errors("chirps"), torch.no_grad():
        return simulate_chirps(moving, radar, chirps, impairments=front, **how)


def warn_if_aliased(moving: Scene | MovingScene, radar: Radar, chirps: Chirps) -> None:
    """Warn if a point, such as one of a limb, exceeds the largest unambiguous range rate."""
    scene = moving if isinstance(moving, Scene) else moving.scene
    motion = moving.advance if isinstance(moving, Scene) else moving
    names = {name for name, thing in scene.objects.items() if thing.velocity is not None}
    names |= set(getattr(moving, "motions", ()))
    if not names:
        return

    def distances(time: float) -> torch.Tensor:
        now = motion(time)
        return torch.cdist(radar.positions, torch.cat([now[name].vertices for name in names]))

    limit = chirps.max_speed(radar.waveform.wavelength, radar.shape[1])
    loop = 0.25 * radar.waveform.wavelength / limit
    starts = torch.linspace(0, (chirps.count - 1) * loop, _INSTANTS)[:-1].tolist()
    with torch.no_grad():
        fastest = max(float((distances(t + loop) - distances(t)).abs().max()) for t in starts)
    if fastest > limit * loop:
        text = refusal_text("exact_signals.aliases", fastest / loop, limit)
        warnings.warn(text, PhysicsWarning, stacklevel=2)


def require_simulated_data(run: RunFile) -> SimulatedData:
    """The `[data]` table of a simulation.

    Raises:
        InputError: The run file's data are measured, not simulated, or there are none.
    """
    data = require_section(run, "data", "a simulation")
    if not isinstance(data, SimulatedData):
        raise refusal("exact_signals.measured_data", data.kind)
    return data


def _settings(run: RunFile, scene: Scene, depth: int) -> dict[str, Any]:
    """Arguments that both kinds of simulation take."""
    data = require_simulated_data(run)
    with prefix_errors("data.mirrors"):
        mirrors = [name for name in data.mirrors if scene[name]]
    rough: Any = {"points_per_m2": data.points_per_m2, "rough_paths": data.rough_paths}
    smooth: Any = {"conductor_samples": data.samples, "boundary_samples": 0, "boundary": False}
    seed = run.seed if data.seed is None else data.seed
    return {"seed": seed, "sampling": Sampling(depth, **smooth, **rough), "mirrors": mirrors}
