"""The forward model on one page: scene → paths → signals → spectrum."""

from dataclasses import dataclass

import torch
from jaxtyping import Complex128, Float
from torch import Tensor

from invertwin.channel.bridge import use_backend
from invertwin.channel.paths import Grid, Paths
from invertwin.channel.tracer import RoughPoints, rough_points, trace_field
from invertwin.errors import InputError
from invertwin.radar.motion import Chirps, moving_beat
from invertwin.radar.radar import Radar
from invertwin.radar.range_profile import add_noise, beat_signal
from invertwin.radar.spectrum import exact_spectrum
from invertwin.radar.surrogate import Surrogate, surrogate_spectrum
from invertwin.scene.scene import Scene


@dataclass(frozen=True)
class Simulation:
    """What a radar would record.

    Attributes:
        spectrum: Power per bin, received over transmitted.
        paths: Field paths of the exact chain (None for the surrogate).
        beat: Beat signal of every virtual channel (None for the surrogate).
    """

    spectrum: Float[Tensor, "frame range u v"]
    paths: Paths | None = None
    beat: Complex128[Tensor, "frame tx rx sample"] | None = None


def simulate(
    scene: Scene,
    radar: Radar,
    grid: Grid,
    *,
    seed: int,
    surrogate: Surrogate | None = None,
    samples: int = 400_000,
    boundary_samples: int = 50_000,
    boundary: bool = True,
    density: float = 20_000.0,
    points: RoughPoints | None = None,
    snr_db: float | None = None,
    noise_figure_db: float | None = None,
    backend: str | None = None,
) -> Simulation:
    """Simulate a capture of a scene.

    Without a surrogate: the exact chain, as a real radar does it. With one: the expected power
    spectrum, smooth in the scene's parameters; both have the same shape and units.

    Args:
        scene: What is seen.
        radar: Arrays, waveform and poses.
        grid: Bins, see ``Radar.grid``.
        seed: Places, phases and noise.
        surrogate: Kernels of the smooth model (None = exact).
        samples: Surrogate: rays over all frames. Exact: samples per frame on conductors.
        boundary_samples: Silhouette samples (surrogate and conductors).
        boundary: Off for fixed-visibility gradients.
        density: Points per m² of rough surfaces (exact).
        points: Rough points to reuse, so that speckle stays while the scene moves (exact).
        snr_db: Noise relative to the mean signal power per sample (exact).
        noise_figure_db: Thermal noise of a receiver instead (exact).
        backend: See ``deposit_power``.

    Raises:
        InputError: An object in motion: a frame is one instant. Noise on a mean spectrum.
    """
    with use_backend(backend):
        if surrogate is not None:
            if snr_db is not None or noise_figure_db is not None:
                raise InputError(
                    "expected no noise with a surrogate, got a noise level; the surrogate is the "
                    "mean spectrum: leave the noise out, or simulate without a surrogate"
                )
            return Simulation(
                surrogate_spectrum(
                    scene,
                    radar,
                    grid,
                    surrogate,
                    samples=samples,
                    boundary_samples=boundary_samples,
                    seed=seed,
                    boundary=boundary,
                )
            )
        paths = trace_field(
            scene,
            radar.link(),
            samples=samples,
            density=density,
            points=points,
            boundary_samples=boundary_samples,
            seed=seed,
            boundary=boundary,
        )
    if paths.velocity is not None:
        names = [n for n, o in scene.objects.items() if o.velocity is not None]
        raise InputError(
            f"expected objects at rest, got velocities on {', '.join(names)}; a frame is one "
            "instant: use scene.at(time), or simulate_chirps for motion within a frame"
        )
    beat = beat_signal(paths, radar)
    if snr_db is not None or noise_figure_db is not None:
        beat = add_noise(beat, radar, snr_db=snr_db, noise_figure_db=noise_figure_db, seed=seed)
    return Simulation(exact_spectrum(beat, radar, grid), paths, beat)


def simulate_chirps(
    scene: Scene,
    radar: Radar,
    chirps: Chirps,
    *,
    seed: int,
    retrace: bool = False,
    samples: int = 400_000,
    density: float = 20_000.0,
    points: RoughPoints | None = None,
    backend: str | None = None,
) -> Complex128[Tensor, "frame chirp tx rx sample"]:
    """Beat signals of a moving scene, chirp by chirp; the radar rests within a frame.

    Every frame starts from the scene as given: move it between frames with ``scene.at(time)``.

    Args:
        scene: Objects with velocities.
        radar: Arrays, waveform and poses.
        chirps: Timing of the ramps.
        seed: Places and phases; those of rough points belong to the surface and move with it.
        retrace: Trace visibility and amplitudes anew at every ramp, instead of moving the
            points seen at the start of the frame.
        samples: Samples per frame on conductors.
        density: Points per m² of rough surfaces.
        points: Rough points to reuse.
        backend: See ``deposit_power``.

    Raises:
        InputError: See ``trace_field`` and ``moving_beat``.
    """
    fixed = points or rough_points(scene, density, seed)

    def traced(instant: Scene) -> Paths:
        return trace_field(
            instant, radar.link(), samples=samples, points=fixed, seed=seed, backend=backend
        )

    if not retrace:
        return moving_beat(traced(scene), radar, chirps)
    rows = []
    for instants in chirps.times(len(radar.transmitters.positions)).tolist():
        beats = {time: beat_signal(traced(scene.at(time)), radar) for time in set(instants)}
        slots = [beats[time][:, tx] for tx, time in enumerate(instants)]
        rows.append(torch.stack(slots, dim=1))
    return torch.stack(rows, dim=1)
