"""The forward model on one page: scene → paths → signals → spectrum."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Complex128, Float
from torch import Tensor

from invertwin.channel import (
    Grid,
    Paths,
    RoughPaths,
    RoughPoints,
    Sampling,
    Speckle,
    draw_speckle,
    trace_field,
    use_backend,
)
from invertwin.errors import InputError
from invertwin.radar.impairments import Impairments
from invertwin.radar.motion import (
    Chirps,
    Places,
    Train,
    every_ramp,
    sample_interval,
)
from invertwin.radar.radar import Radar, sampled
from invertwin.radar.range_profile import add_noise, beat_signal, check_paths
from invertwin.radar.spectrum import exact_spectrum
from invertwin.radar.surrogate import Surrogate, chosen_surrogate, surrogate_spectrum
from invertwin.scene.scene import Scene

# Motion over half a ramp is straight where it bends by less than this, in wavelengths.
_STRAIGHT = 1e-6


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
    surrogate: Surrogate | str | None = None,
    depth: int = 3,
    samples: int = 400_000,
    boundary_samples: int = 50_000,
    boundary: bool = True,
    density: float = 20_000.0,
    points: RoughPoints | None = None,
    chains: RoughPaths | None = None,
    chain_count: int = 200_000,
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
        surrogate: The smooth model, or its name among ``SURROGATES``; None, "exact" = exact chain.
        depth: Most bounces of a path.
        samples: Surrogate: rays over all frames. Exact: samples per frame on conductors.
        boundary_samples: Silhouette samples (surrogate and conductors).
        boundary: Off for fixed-visibility gradients.
        density: Points per m² of rough surfaces (exact).
        points: Rough points to reuse, so that speckle stays while the scene moves (exact).
        chains: Rough chains of several bounces to reuse, likewise.
        chain_count: How many to draw of each length instead (exact).
        snr_db: Noise relative to the mean signal power per sample (exact).
        noise_figure_db: Thermal noise of a receiver instead (exact).
        backend: See ``deposit_power``.

    Raises:
        InputError: An object in motion: a frame is one instant. Noise on a mean spectrum.
    """
    smooth = chosen_surrogate(surrogate)
    sampling = Sampling(
        depth=depth,
        samples=samples,
        boundary_samples=boundary_samples,
        boundary=boundary,
        points_per_m2=density,
        rough_paths=chain_count,
    )
    with use_backend(backend):
        if smooth is not None:
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
                    smooth,
                    sampling=sampling,
                    seed=seed,
                )
            )
        moving = [name for name, item in scene.objects.items() if item.velocity is not None]
        if moving:
            raise InputError(
                f"expected objects at rest, got velocities on {', '.join(moving)}; a frame is one "
                "instant: use scene.at(time), or simulate_chirps for motion within a frame"
            )
        paths = trace_field(
            scene,
            radar.link(),
            sampling=sampling,
            seed=seed,
            speckle=Speckle(points, chains),
        )
    beat = beat_signal(paths, radar)
    if snr_db is not None or noise_figure_db is not None:
        beat = add_noise(beat, radar, snr_db=snr_db, noise_figure_db=noise_figure_db, seed=seed)
    return Simulation(exact_spectrum(beat, radar, grid), paths, beat)


def surrogate_correlation(
    scene: Scene,
    radar: Radar,
    grid: Grid,
    *,
    seed: int,
    surrogate: Surrogate | str = "response",
    looks: int = 16,
    samples: int = 400_000,
    depth: int = 3,
    density: float = 20_000.0,
) -> float:
    """How well a surrogate's map is that of the exact chain, the mean over looks at the scene.

    A look has its own phases of the rough surfaces. One look is speckle as strong as the map
    itself; a scene of conductors has none, and looks the same each time.

    Args:
        scene: What is seen.
        radar: Arrays, waveform and poses.
        grid: Bins, see ``Radar.grid``.
        seed: Of the first look, and of the surrogate's samples.
        surrogate: The smooth model, or its name.
        looks: Exact spectra that are averaged.
        samples: As in :func:`simulate`.
        depth: Most bounces of a path.
        density: Points per m² of rough surfaces.

    Returns:
        Pearson's correlation over all bins and frames; 0 where a map is constant.

    Raises:
        InputError: No looks; "exact", which is no surrogate.
    """
    smooth = chosen_surrogate(surrogate)
    if looks < 1 or smooth is None:
        raise InputError(
            f"expected looks >= 1 and a surrogate, got {looks} and {surrogate!r}; 16 looks leave "
            "a quarter of the speckle"
        )
    if all(item.material.coherent for item in scene.objects.values()):
        looks = 1
    with torch.no_grad():
        mean = torch.zeros(radar.frame_count, *grid.shape, dtype=torch.float64)
        for look in range(looks):
            found = simulate(
                scene, radar, grid, seed=seed + look, samples=samples, density=density, depth=depth
            )
            mean += found.spectrum / looks
        twin = simulate(
            scene, radar, grid, seed=seed, surrogate=smooth, samples=samples, depth=depth
        )
        a, b = (power.double() - power.double().mean() for power in (mean, twin.spectrum))
        norms = a.norm() * b.norm()
    return float((a * b).sum() / norms) if norms > 0 else 0.0


def simulate_chirps(
    scene: Scene | Callable[[float], Scene],
    radar: Radar,
    chirps: Chirps,
    *,
    seed: int,
    retrace: bool = False,
    samples: int = 400_000,
    density: float = 20_000.0,
    points: RoughPoints | None = None,
    impairments: Impairments | None = None,
    backend: str | None = None,
) -> Complex128[Tensor, "frame chirp tx rx sample"]:
    """Beat signals of a moving scene, chirp by chirp; the radar rests within a frame.

    A scene moves with the velocities of its objects. Any other motion is a function of time:
    ``lambda time: scene.replace("rotor", pose=...)`` gives the scene at that many seconds after
    the start of the frame, the same objects with the same triangles. It is traced in the middle
    of every ramp; the points seen there follow it over the ramp, along parabolas that are exact
    at the first, middle and last sample. See ``moving_beat`` for what is exact.

    Every frame starts from the scene as given: move it between frames with ``scene.at(time)``.

    Args:
        scene: Objects with velocities, or the scene at any time [s].
        radar: Arrays, waveform and poses.
        chirps: Timing of the ramps.
        seed: Places and phases; those of rough points belong to the surface and move with it.
        retrace: Trace visibility and amplitudes anew at every ramp, instead of moving the
            points seen at the start of the frame. A function of time always does.
        samples: Samples per frame on conductors.
        density: Points per m² of rough surfaces.
        points: Rough points to reuse.
        impairments: Of the front end, drawn from the seed too; phase noise only without retracing.
        backend: See ``deposit_power``.

    Raises:
        InputError: See ``trace_field`` and ``moving_beat``; a function of time whose objects
            change their triangles; phase noise where rays are traced anew.
    """
    again = retrace or not isinstance(scene, Scene)
    if again and impairments is not None:
        impairments.check_applicable()
    motion = scene.at if isinstance(scene, Scene) else scene
    sampling = Sampling(
        depth=1, samples=samples, boundary_samples=0, points_per_m2=density, backend=backend
    )
    start = motion(0.0)
    fixed = Speckle(points) if points else draw_speckle(start, radar.link(), sampling, seed)

    def traced(instant: Scene) -> Paths:
        return trace_field(instant, radar.link(), sampling=sampling, seed=seed, speckle=fixed)

    if isinstance(scene, Scene) and not again:
        front = impairments or Impairments()
        return front.record(traced(scene), radar, seed=seed, chirps=chirps)
    half = 0.5 * (sampled(radar).samples - 1) * sample_interval(sampled(radar))

    def ramp(start: float, senders: list[int]) -> Tensor:
        paths, places = _over_a_ramp(motion, start + half, half, traced, radar)
        check_paths(paths, radar, sampled(radar))
        return Train(paths, radar, places).ramp(start, senders)

    beat = every_ramp(chirps, len(radar.transmitters.positions), ramp)
    return beat if impairments is None else impairments.apply(beat, radar, seed=seed)


def _over_a_ramp(
    motion: Callable[[float], Scene],
    middle: float,
    half: float,
    traced: Callable[[Scene], Paths],
    radar: Radar,
) -> tuple[Paths, Places]:
    """Paths in the middle of a ramp, and where their points are half a ramp before and after."""
    scene = motion(middle)
    ahead = _displacements(scene, motion(middle + half))
    behind = _displacements(scene, motion(middle - half))
    # A trace interpolates the velocities of vertices at its points; so it does displacements.
    paths = traced(_with_velocities(scene, ahead))
    if paths.velocity is None:
        return paths, lambda time: paths.first
    # Paths of several bounces stand still within a ramp.
    alone = (paths.first == paths.last).all(dim=1, keepdim=True)
    forward = paths.velocity * alone
    bend = max(float((ahead[n] + behind[n]).norm(dim=1).max()) for n in scene.names)
    backward = -forward
    if bend > _STRAIGHT * radar.waveform.wavelength:
        again = traced(_with_velocities(scene, behind)).velocity
        assert again is not None
        assert again.shape == forward.shape  # The same scene and seed, so the same points.
        backward = again * alone
    slope, curve = 0.5 * (forward - backward), 0.5 * (forward + backward)

    def places(time: float) -> Tensor:
        part = (time - middle) / half
        return paths.first + slope * part + curve * part**2

    return paths, places


def _displacements(scene: Scene, other: Scene) -> dict[str, Tensor]:
    """How far the vertices of one instant are at another."""
    if scene.names != other.names:
        raise InputError(
            f"expected the same objects at all times, got {', '.join(scene.names)} and "
            f"{', '.join(other.names)}; move objects out of sight instead of leaving them out"
        )
    found = {}
    for name in scene.names:
        here, there = scene[name], other[name]
        if not torch.equal(here.mesh.faces, there.mesh.faces):
            raise InputError(
                f"expected the same triangles of {name!r} at all times, got others; "
                "move its vertices only"
            )
        found[name] = (there.vertices - here.vertices).detach()
    return found


def _with_velocities(scene: Scene, values: dict[str, Tensor]) -> Scene:
    for name, value in values.items():
        scene = scene.replace(name, velocity=value if value.any() else None)
    return scene
