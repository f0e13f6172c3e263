"""Simulate exact signals as a real radar records them: scene → paths → beat signal → spectrum."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Complex128, Float
from torch import Tensor

from invertwin import channel
from invertwin.capture.capture import Capture
from invertwin.channel import Grid, Paths, Sampling, Speckle
from invertwin.checks import checked_count, checked_type
from invertwin.errors import InputError
from invertwin.radar.processing.beamforming import exact_spectrum
from invertwin.radar.radar import Radar, require_sampled_waveform
from invertwin.radar.signal import chirps as trains
from invertwin.radar.signal.impairments import Impairments
from invertwin.radar.signal.keyframes import VisibilityKeyframes, vertex_displacements
from invertwin.radar.signal.range_profile import add_noise, beat_signal, check_paths
from invertwin.runtime.concurrency import torch_threads
from invertwin.scene.scene import Scene, warn_if_purely_specular

# Motion over half a ramp is straight where it bends by less than this, in wavelengths.
_STRAIGHT_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Simulation:
    """Simulated signals of a radar.

    Attributes:
        spectrum: Power per bin, received over transmitted.
        paths: Field paths.
        beat: Beat signal of every virtual channel.
        radar: The radar that records them.
    """

    spectrum: Float[Tensor, "frame range u v"]
    paths: Paths
    beat: Complex128[Tensor, "frame tx rx sample"]
    radar: Radar

    @cached_property
    def capture(self) -> Capture:
        """The beat signal as a recording of the radar, as measured data are."""
        return Capture.from_beat(self.beat, self.radar)


def simulate(
    scene: Scene,
    radar: Radar,
    grid: Grid,
    *,
    seed: int,
    sampling: Sampling | None = None,
    speckle: Speckle | None = None,
    snr_db: float | None = None,
    noise_figure_db: float | None = None,
    impairments: Impairments | None = None,
    mirrors: Collection[str] = (),
) -> Simulation:
    """Simulate a capture of a scene: exact signals with noise.

    The smooth mean of such spectra is predicted by ``invertwin.SurrogateMap``.

    Args:
        scene: Scene to trace.
        radar: Arrays, waveform and poses.
        grid: Bins, see ``Radar.grid``.
        seed: Seed of places, phases and noise.
        sampling: Sampling of paths; None = ``Sampling()``.
        speckle: Rough points and paths to use again, so that speckle stays while the scene moves.
        snr_db: Noise relative to the mean signal power per sample.
        noise_figure_db: Thermal noise of a receiver instead.
        impairments: Impairments of the front end; they have a noise level of their own.
        mirrors: Names of smooth flat objects, such as a wall, in which the rest is seen a second
            time (ghosts): paths of up to ``sampling.depth`` surfaces that scatter once.

    Raises:
        InputError: An object in motion: a frame is one instant. Two noise levels. A mirror that is
            missing, or smooth nowhere.
    """
    checked_type(scene, Scene, "a scene", "build one with Scene({name: Object(...)})")
    checked_type(radar, Radar, "a radar", "build one with Radar(...), or capture.radar()")
    checked_type(grid, Grid, "a grid of bins", "make one with radar.grid(...)")
    moving = [name for name, item in scene.objects.items() if item.velocity is not None]
    if moving:
        raise InputError(
            f"expected objects at rest, got velocities on {', '.join(moving)}; a frame is one "
            "instant: use scene.at(time), or simulate_chirps for motion within a frame"
        )
    warn_if_purely_specular(scene, radar.waveform.center_frequency)
    noisy = snr_db is not None or noise_figure_db is not None
    if noisy and impairments is not None:
        raise InputError(
            "expected the noise level in the impairments, got one beside them; give "
            "Impairments(snr_db=...)"
        )
    plan = sampling or Sampling()
    paths = channel.trace_field_with_mirrors(
        scene, radar.link(), mirrors, sampling=plan, seed=seed, speckle=speckle
    )
    if impairments is not None:
        beat = impairments.record(paths, radar, seed=seed)
    else:
        beat = beat_signal(paths, radar)
        if noisy:
            beat = add_noise(beat, radar, snr_db=snr_db, noise_figure_db=noise_figure_db, seed=seed)
    return Simulation(exact_spectrum(beat, radar, grid), paths, beat, radar)


def simulate_chirps(
    scene: Scene | Callable[[float], Scene],
    radar: Radar,
    chirps: trains.Chirps,
    *,
    seed: int,
    sampling: Sampling | None = None,
    retrace: bool = False,
    visibility_every: int = 1,
    speckle: Speckle | None = None,
    impairments: Impairments | None = None,
    mirrors: Collection[str] = (),
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
        sampling: Sampling of paths, of one bounce; None: depth 1, and 3 with mirrors.
        retrace: Trace visibility and amplitudes anew at every ramp, instead of moving the
            points seen at the start of the frame. A function of time always does, but see the next.
        visibility_every: Loops for which visibility and amplitudes of a function of time are kept;
            those of their middle. Rays are traced once for them. Delays stay exact: points follow
            their surface at every ramp, and what stands still is summed once. Without derivatives.
        speckle: Rough points to use again.
        impairments: Impairments of the front end; phase noise only without retracing.
        mirrors: Names as of ``simulate``, of objects at rest; not with motion traced at every ramp.

    Raises:
        InputError: See ``trace_field`` and ``moving_beat``; a function of time whose objects
            change their triangles; phase noise where rays are traced anew; visibility kept for
            several loops where nothing is traced anew, or of paths of several bounces.
    """
    checked_type(radar, Radar, "a radar", "build one with Radar(...)")
    checked_type(
        chirps, trains.Chirps, "the timing of chirps", "build it with Chirps(count, interval)"
    )
    again = retrace or not isinstance(scene, Scene)
    if again and impairments is not None:
        impairments.check_applicable()
    motion = scene.advance if isinstance(scene, Scene) else scene
    plan = sampling or (Sampling() if mirrors else Sampling(depth=1))
    _check_tracing(plan, again, retrace, visibility_every, mirrors)
    if not (speckle or mirrors):  # one trace draws its own points; those of several are the same
        speckle = channel.draw_speckle(motion(0.0), radar.link(), plan, seed)

    def trace_instant(instant: Scene) -> Paths:
        how: Any = {"sampling": plan, "seed": seed, "speckle": speckle}
        return channel.trace_field_with_mirrors(instant, radar.link(), mirrors, **how)

    if isinstance(scene, Scene) and not again:
        front = impairments or Impairments()
        return front.record(trace_instant(scene), radar, seed=seed, chirps=chirps)
    if visibility_every > 1:
        plan = replace(plan, boundary=False)
        # Ramps of what moves are small work, which several threads on a busy machine slow tenfold.
        with torch.no_grad(), torch_threads(1):
            blocks = VisibilityKeyframes(motion, trace_instant, radar, chirps, visibility_every)
            beat = trains.simulate_chirp_train(chirps, radar.shape[1], blocks.simulate_ramp)
        return beat if impairments is None else impairments.apply(beat, radar, seed=seed)
    waveform = require_sampled_waveform(radar)
    half = 0.5 * (waveform.samples - 1) * trains.sample_interval(waveform)

    def simulate_ramp(start: float, senders: list[int]) -> Tensor:
        paths, places = _trace_ramp(motion, start + half, half, trace_instant, radar)
        check_paths(paths, radar, waveform)
        return trains.ChirpTrain(paths, radar, places).simulate_ramp(start, senders)

    beat = trains.simulate_chirp_train(chirps, radar.shape[1], simulate_ramp)
    return beat if impairments is None else impairments.apply(beat, radar, seed=seed)


def _check_tracing(
    plan: Sampling, again: bool, retrace: bool, visibility_every: int, mirrors: Collection[str]
) -> None:
    """Raise an error for mirrors or kept visibility that this tracing does not support."""
    if mirrors and again:
        raise InputError(
            f"expected uniform velocities with mirrors, got {len(mirrors)} mirrors and motion that "
            "is traced at every ramp; give a Scene with velocities and retrace=False"
        )
    if checked_count(visibility_every, "visibility_every", 1) > 1 and (plan.depth > 1 or not again):
        raise InputError(
            f"expected visibility_every 1 with {plan.depth} bounces and retrace={retrace}, got "
            f"{visibility_every}; it is for paths of one bounce of a function of time"
        )


def _trace_ramp(
    motion: Callable[[float], Scene],
    middle: float,
    half_duration: float,
    trace: Callable[[Scene], Paths],
    radar: Radar,
) -> tuple[Paths, trains.PointTrajectory]:
    """Paths in the middle of a ramp, and where their points are half a ramp before and after."""
    scene = motion(middle)
    ahead = vertex_displacements(scene, motion(middle + half_duration))
    behind = vertex_displacements(scene, motion(middle - half_duration))
    # A trace interpolates the velocities of vertices at its points; so it does displacements.
    paths = trace(_set_velocities(scene, ahead))
    if paths.velocity is None:
        return paths, lambda time: paths.first
    # Paths of several bounces stand still within a ramp.
    alone = (paths.first == paths.last).all(dim=1, keepdim=True)
    forward = paths.velocity * alone
    bend = max(float((ahead[n] + behind[n]).norm(dim=1).max()) for n in scene.names)
    backward = -forward
    if bend > _STRAIGHT_TOLERANCE * radar.waveform.wavelength:
        again = trace(_set_velocities(scene, behind)).velocity
        assert again is not None
        assert again.shape == forward.shape  # The same scene and seed, so the same points.
        backward = again * alone
    slope, curve = 0.5 * (forward - backward), 0.5 * (forward + backward)

    def point_positions(time: float) -> Tensor:
        part = (time - middle) / half_duration
        return paths.first + slope * part + curve * part**2

    return paths, point_positions


def _set_velocities(scene: Scene, values: dict[str, Tensor]) -> Scene:
    for name, value in values.items():
        scene = scene.replace(name, velocity=value if value.any() else None)
    return scene
