"""Forward model of chirp trains: power over range, Doppler and direction."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from invertwin import channel
from invertwin.capture.chirp_capture import ChirpCapture
from invertwin.channel import Grid, Paths, Sampling
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel, Realisations
from invertwin.models.noise import noisy_realisations
from invertwin.radar import Chirps, Radar, SampledWaveform, range_doppler_angle, velocity_axis
from invertwin.radar.surrogate.range_doppler import range_doppler_power
from invertwin.scene.scene import Scene
from invertwin.seeds import derive_seed
from invertwin.simulation import simulate_chirps

_LOOK_POINTS = 300  # of the largest moving surface
_Maps = Float[Tensor, "frame velocity range u v"]  # power of every frame


@dataclass(frozen=True, eq=False)
class RangeDopplerMap(ForwardModel):
    """Power over range rate, range and direction of moving targets.

    Static echoes are removed from a recording by subtracting the mean over the chirps, so a
    prediction includes only objects with a velocity; static objects occlude them. Silhouettes have
    no boundary term: the power of a rough convex body vanishes towards its silhouette.

    Attributes:
        grid: Ranges and directions.
        chirps: Timing of the ramps.
        rates: Range rates of the map, positive away from the radar [m/s]; a subset of ``bins``.
        bins: Number of range-rate bins over the whole unambiguous span.
        sampling: Sampling of paths; one bounce, fixed visibility.
        mirrors: Names of smooth flat objects at rest that form mirror images (ghosts) of moving
            objects: paths of up to three surfaces.
    """

    grid: Grid
    chirps: Chirps
    rates: Float64[Tensor, " velocity"]
    bins: int
    sampling: Sampling = Sampling(depth=1, boundary=False)
    mirrors: Sequence[str] = ()

    # Each takes seconds; 16 determine a standard deviation to 18 %.
    realisation_count: ClassVar[int] = 16

    @classmethod
    def from_chirps(
        cls,
        radar: Radar,
        grid: Grid,
        chirps: Chirps,
        oversample: int = 2,
        sampling: Sampling | None = None,
        mirrors: Sequence[str] = (),
    ) -> "RangeDopplerMap":
        """Create a map of all range rates that the chirps resolve.

        Args:
            radar: Radar that records.
            grid: Ranges and directions.
            chirps: Timing of the ramps.
            oversample: Number of range-rate bins per cell.
            sampling: Sampling of paths.
            mirrors: Smooth flat objects at rest.
        """
        bins, how = oversample * chirps.count, sampling or cls.sampling
        return cls(grid, chirps, velocity_axis(radar, chirps, bins), bins, how, mirrors)

    def __post_init__(self) -> None:
        if self.sampling.depth != 1 or self.sampling.boundary:
            raise InputError(
                "expected Sampling(depth=1, boundary=False) for a MotionMap, got depth "
                f"{self.sampling.depth} and boundary {self.sampling.boundary}; moving paths have "
                "one bounce and fixed visibility"
            )

    def predict(self, scene: Scene, sensor: Radar, seed: int) -> _Maps:
        """Predict the expected power of moving targets. See ``ForwardModel.predict``.

        Raises:
            InputError: No object has a velocity.
        """
        if all(item.velocity is None for item in scene.objects.values()):
            raise InputError(
                "expected an object with a velocity for a MotionMap, got none; give one a "
                "velocity, or fit a MovingBody"
            )
        link, rest = sensor.link(), channel.without_specular(scene, self.mirrors)
        paths = channel.trace_power(rest, link, sampling=self.sampling, seed=seed)
        if self.mirrors:
            how: Any = {"sampling": replace(self.sampling, depth=Sampling.depth), "seed": seed}
            paths += channel.trace_mirrored_power(scene, link, self.mirrors, **how)
        assert paths.velocity is not None
        return self.predict_paths(paths.select((paths.velocity.detach() != 0).any(1)), sensor)

    def predict_paths(self, paths: Paths, radar: Radar) -> _Maps:
        """Compute the map of moving paths. See ``range_doppler_power``.

        Args:
            paths: Paths with velocities.
            radar: Radar that records them.
        """
        assert paths.velocity is not None
        return range_doppler_power(paths, paths.velocity, radar, self.grid, self.chirps, self.rates)

    def observe(self, recording: ChirpCapture) -> _Maps:
        """Return the measured power of moving targets.

        Raises:
            InputError: A recording with another number of chirps.
        """
        beat, radar = recording.beat, recording.radar()
        moving = (beat - beat.mean(1, keepdim=True)).to(torch.complex128)
        power = range_doppler_angle(moving, radar, self.grid, self.chirps, bins=self.bins)
        rows = (velocity_axis(radar, self.chirps, self.bins) - self.rates[:, None]).abs().argmin(1)
        return power[:, rows]

    def realisations(self, scene: Scene, sensor: Radar, seed: int) -> Realisations:
        """Return recordings of the moving scene with independent speckle and noise.

        A few hundred points of each surface are enough for developed speckle.
        """
        middle = float(self.chirps.times(len(sensor.transmitters.positions)).mean())
        still = {n: o for n, o in scene.objects.items() if o.velocity is None}
        moving = {
            name: replace(item.advance(-middle), velocity=item.velocity)
            for name, item in scene.objects.items()
            if item.velocity is not None
        }
        begun = Scene({**still, **moving})
        area = max(item.mesh.area for item in moving.values())
        depth = Sampling.depth if self.mirrors else 1
        drawn = Sampling(depth, boundary=False, points_per_m2=_LOOK_POINTS / area)
        assert isinstance(sensor.waveform, SampledWaveform)
        channels = (*sensor.shape[1:], sensor.waveform.samples)
        shape = (sensor.frame_count, self.chirps.count, *channels)

        def to_map(beat: Tensor) -> Tensor:
            return self.observe(ChirpCapture(beat, sensor, self.chirps))

        def simulate_beat(number: int) -> Tensor:
            own = derive_seed(number, 0)
            how = begun, sensor, self.chirps
            return simulate_chirps(*how, seed=own, sampling=drawn, mirrors=self.mirrors)

        return noisy_realisations(simulate_beat, to_map, shape, seed, dtype=torch.complex128)

    def crop_around(
        self, range_: float, rate: float, cells: int, radar: Radar
    ) -> "RangeDopplerMap":
        """Crop the map to range and Doppler cells around an echo, in all directions.

        Args:
            range_: Range of the echo [m].
            rate: Range rate of the echo [m/s].
            cells: Number of cells to either side.
            radar: Radar that records.
        """
        doppler = velocity_axis(radar, self.chirps).diff()[0] if self.chirps.count > 1 else math.inf
        near = (self.grid.ranges - range_).abs() / radar.waveform.range_resolution
        slow = (self.rates - rate).abs() / doppler
        ranges, rates = (torch.nonzero(d <= cells)[:, 0] for d in (near, slow))
        if not len(ranges) or not len(rates):
            raise InputError(
                f"expected an echo within the map, got one at {range_:.3g} m and {rate:.3g} m/s; "
                "widen the grid"
            )
        start, count = float(self.grid.ranges[ranges[0]]), len(ranges)
        grid = replace(self.grid, range_start=start, range_count=count)
        return replace(self, grid=grid, rates=self.rates[rates])
