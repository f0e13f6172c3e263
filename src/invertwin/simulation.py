"""The forward model on one page: scene → paths → signals → spectrum."""

from dataclasses import dataclass

from jaxtyping import Complex128, Float
from torch import Tensor

from invertwin.channel.bridge import use_backend
from invertwin.channel.paths import Grid, Paths
from invertwin.channel.tracer import RoughPoints, trace_field
from invertwin.radar.range_profile import add_noise, beat_signal
from invertwin.radar.spectrum import exact_spectrum
from invertwin.radar.surrogate import Surrogate, surrogate_spectrum
from invertwin.radar.waveform import Radar
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
        InputError: An object in motion: a frame is one instant.
    """
    with use_backend(backend):
        if surrogate is not None:
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
    beat = beat_signal(paths, radar)
    if snr_db is not None or noise_figure_db is not None:
        beat = add_noise(beat, radar, snr_db=snr_db, noise_figure_db=noise_figure_db, seed=seed)
    return Simulation(exact_spectrum(beat, radar, grid), paths, beat)
