"""Radar: antenna arrays, a waveform and poses, and the bins that they resolve."""

import math
import warnings
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from annotated_types import Ge, Gt, Le
from jaxtyping import Complex, Complex128, Float64, Int64
from torch import Tensor

from invertwin import checks
from invertwin.channel import Grid, Link, Paths
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.limits import MAX_COUNT, MAX_LENGTH, AllowedValues
from invertwin.radar.waveform import WINDOWS, PhysicsWarning, SampledWaveform, Waveform
from invertwin.runtime.memory import require_at_most
from invertwin.scene.antenna import AntennaArray
from invertwin.scene.pose import rotate_about_mean

Window = Annotated[str, AllowedValues(WINDOWS)]
Cosine = Annotated[float, Gt(0), Le(1)]
# Antennas closer than this share one visibility test.
_SHARED_VISIBILITY_DISTANCE = 0.1
# Arrays have λ/2 at some frequency of the band, not exactly at its centre.
_SPACING_TOLERANCE = 1.05
_MAX_CHANNELS = 1e6
_MAX_BINS = 2**28  # 2 GB for one frame


@dataclass(frozen=True, eq=False)
class Radar:
    """Antenna arrays, a waveform, and one or more poses.

    Element positions are in the radar frame (x boresight, y left, z up); ``positions`` is the
    origin of that frame in the world and the columns of ``rotations`` are its axes. The phase
    centre of an array is the mean of its element positions.

    Attributes:
        transmitters: Transmitting array.
        receivers: Receiving array.
        waveform: ``FMCW``, ``SteppedFrequency``, ``OFDM``, ``Impulse`` or a subclass of
            ``Waveform``.
        positions: World position of the radar in each frame [m]; may carry a gradient.
        rotations: orientation in each frame; None = world axes.
        window: Taper of the samples before the range transform.
        array_window: Taper of the virtual array along y and along z.
        shared_visibility: one visibility test for both antennas; None = if the phase centres are at
            most 0.1 m apart.
        range_bias: bias of all ranges of the surrogate [m]; may carry a gradient. Exact signals
            reject it.
        range_origin: range from which each frame counts its own [m], as after motion compensation
            to a scene centre, see ``center_on``: an echo from R appears at R minus the origin. None
            = the radar. It is a constant of the data, independent of the positions.

    Raises:
        InputError: Wrong shapes, non-finite values, matrices that are not rotations, unknown
            windows, separate visibility with several transmitters, or origins that carry
            derivatives.
    """

    transmitters: AntennaArray
    receivers: AntennaArray
    waveform: Waveform
    positions: Float64[Tensor, "frame 3"]
    rotations: Float64[Tensor, "frame 3 3"] | None = None
    window: Window = "hamming"
    array_window: Window = "hamming"
    shared_visibility: bool | None = None
    range_bias: float | Float64[Tensor, ""] = 0.0
    range_origin: Float64[Tensor, " frame"] | None = None

    def __post_init__(self) -> None:
        do = "give one position [x, y, z] in metres per pose"
        positions = checks.checked_positions(self.positions, "radar positions", "radar pose", do)
        checks.set_fields(self, positions=positions)
        if self.rotations is not None:
            checks.set_fields(self, rotations=_checked_rotations(self.rotations, len(positions)))
        if self.range_origin is not None:
            checks.set_fields(self, range_origin=_checked_origin(self.range_origin, len(positions)))
        checks.check_fields(self)
        if not self._shared_visibility and self.shape[1] > 1:
            raise InputError(
                f"expected one transmitter when TX and RX see separately, got {self.shape[1]}; "
                "set shared_visibility=True or use one transmitter"
            )
        what, pairs = "pairs of a transmitter and a receiver", self.shape[1] * self.shape[2]
        require_at_most(pairs, _MAX_CHANNELS, what, "use fewer elements", "receivers")
        self._warn_about_spacing()

    @property
    def frame_count(self) -> int:
        """Number of poses."""
        return self.positions.shape[0]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of poses, transmitters and receivers."""
        return self.frame_count, len(self.transmitters.positions), len(self.receivers.positions)

    @property
    def virtual_positions(self) -> Float64[Tensor, "virtual 3"]:
        """TX + RX element offsets from their phase centres, TX-major, in the radar frame [m]."""
        tx, rx = self.transmitters.positions, self.receivers.positions
        tx, rx = tx - tx.mean(0), rx - rx.mean(0)
        return (tx[:, None] + rx[None]).reshape(-1, 3)

    @property
    def aperture(self) -> tuple[float, float]:
        """Extent of the virtual array along y and z plus half a wavelength [m]."""
        places = self.virtual_positions
        extent = places.amax(0) - places.amin(0)
        half = 0.5 * self.waveform.wavelength
        return float(extent[1]) + half, float(extent[2]) + half

    @property
    def beamwidth(self) -> tuple[float, float]:
        """Resolution cell in u and in v, λ/D with D the virtual aperture."""
        width, height = self.aperture
        return self.waveform.wavelength / width, self.waveform.wavelength / height

    def elements(self) -> tuple[Float64[Tensor, "frame tx 3"], Float64[Tensor, "frame rx 3"]]:
        """World positions of all TX and RX elements [m]."""
        return self._world(self.transmitters.positions), self._world(self.receivers.positions)

    @property
    def has_range_bias(self) -> bool:
        """True if ranges have a bias, or a derivative with respect to one."""
        bias = torch.as_tensor(self.range_bias)
        return checks.is_differentiated(bias) or bool(bias)

    @property
    def origins(self) -> Float64[Tensor, " frame"]:
        """Range from which each frame counts its own, 0 = the radar [m]."""
        if self.range_origin is not None:
            return self.range_origin
        return torch.zeros(self.frame_count, dtype=torch.float64, device=self.positions.device)

    @property
    def origin_delays(self) -> Float64[Tensor, " frame"]:
        """Delay of an echo from the origin of each frame's ranges [s]."""
        return self.origins * (2 / SPEED_OF_LIGHT)

    @property
    def range_limits(self) -> tuple[float, float]:
        """Limits of the unambiguous range interval, from the origin [m].

        With an origin the interval starts half its length before the origin, but not behind the
        radar; without an origin it starts at 0. A waveform without samples has no upper limit.
        """
        nearest = 0.0 - float(self.origins.min())
        if not isinstance(self.waveform, SampledWaveform):
            return nearest, math.inf
        low = max(nearest, -0.5 * self.waveform.max_range)
        return low, low + self.waveform.max_range

    def center_on(self, point: checks.ArrayLike) -> "Radar":
        """Return the radar of data with motion compensation to a point, which has range 0 in them.

        The origins follow from the present positions, without derivatives.

        Args:
            point: centre of the scene in the world [m].
        """
        center = checks.checked_point(point, "the centre of the scene [m]")
        link = self.link()
        ways = (link.tx - center).norm(dim=1) + (link.rx - center).norm(dim=1)
        return replace(self, range_origin=0.5 * ways.detach())

    def link(self) -> Link:
        """Return the inputs of the channel: phase centres, axes, patterns, polarisations."""
        return Link(
            tx=self._world(self.transmitters.positions.mean(0, keepdim=True))[:, 0],
            rx=self._world(self.receivers.positions.mean(0, keepdim=True))[:, 0],
            rotations=self._rotations,
            tx_pattern=self.transmitters.pattern,
            rx_pattern=self.receivers.pattern,
            tx_jones=self.transmitters.jones,
            rx_jones=self.receivers.jones,
            wavelength=self.waveform.wavelength,
            shared_visibility=self._shared_visibility,
            range_origin=self.range_origin,
        )

    def coefficient(
        self, paths: Paths, transmitter: int, receiver: int
    ) -> Complex128[Tensor, " path"]:
        """Return field coefficients of paths for one of the channels.

        Args:
            paths: field paths.
            transmitter, receiver: indices of the elements.

        Raises:
            InputError: Paths of antennas with other polarisation bases.
        """
        if paths.matrix is None:
            return paths.coefficient
        sent, received = self.transmitters.jones.mixtures, self.receivers.jones.mixtures
        expected, do = (None, received.shape[1], sent.shape[1]), "trace with the link of this radar"
        checks.check_shape(paths.matrix, expected, "paths (path, received, sent polarisation)", do)
        return torch.einsum("r,prt,t->p", received[receiver], paths.matrix, sent[transmitter])

    def transform_rigidly(
        self, rotation: Float64[Tensor, "3 3"], translation: Float64[Tensor, "3"]
    ) -> "Radar":
        """Transform all poses rigidly: rotate about the mean position, then translate.

        Args:
            rotation: world rotation matrix [3, 3].
            translation: world translation [3] [m].
        """
        places = rotate_about_mean(self.positions, rotation) + translation
        return replace(self, positions=places, rotations=rotation @ self._rotations)

    def frames(self, indices: Sequence[int] | Int64[Tensor, " chosen"]) -> "Radar":
        """Return the radar with selected poses."""
        chosen = torch.as_tensor(indices, dtype=torch.int64)
        if not len(chosen):
            return replace(self, positions=self.positions[chosen])  # raises the error
        # Copy without validation, since a fit calls this in every step.
        radar, places, turns = copy(self), self.positions[chosen], self._rotations[chosen]
        origin = None if self.range_origin is None else self.range_origin[chosen]
        checks.set_fields(radar, positions=places, rotations=turns, range_origin=origin)
        return radar

    def grid(
        self,
        range_min: float,
        range_max: float,
        u_max: Cosine = 1.0,
        v_max: Cosine = 1.0,
        oversample: Annotated[float, Ge(1)] = 2.0,
    ) -> Grid:
        """Return bins that sample the spectrum without loss.

        Ranges fall on the bins of a zero-padded FFT and are spaced by one range cell over
        ``oversample`` (2 = Nyquist of the power profile). Direction cosines are spaced by
        λ/(2·oversample·D), D the virtual aperture (1 = Nyquist of the power pattern), and end at
        ±1. An axis without extent of the virtual array is not resolved.

        Args:
            range_min: minimum range [m], at least 0 without a range origin.
            range_max: maximum range [m].
            u_max: maximum direction cosine to the left; the map is symmetric.
            v_max: maximum direction cosine upwards; the map is symmetric.
            oversample: bins per resolution cell.

        Raises:
            InputError: The limits are not increasing, out of bounds, or beyond the unambiguous
                range.
        """
        low, high = self.range_limits
        # The origins of recorded data are rounded, like the limits.
        least = low - 1e-9 * abs(low)
        if not least <= range_min < range_max < math.inf:
            raise InputError(
                f"expected {low:.4g} <= range_min < range_max, got {range_min} and {range_max}; "
                "give the limits in metres"
            )
        if not (0 < u_max <= 1 and 0 < v_max <= 1 and oversample >= 1):
            raise InputError(
                f"expected u_max and v_max in (0, 1] and oversample >= 1, got {u_max}, {v_max} "
                f"and {oversample}; direction cosines are sines of angles"
            )
        step = self.waveform.range_resolution / oversample
        if isinstance(self.waveform, SampledWaveform):
            if range_max > high + 1e-9 * self.waveform.max_range:
                raise InputError(
                    f"expected range_max within the unambiguous {high:.4g} m, got {range_max:g}; "
                    "give metres, finer frequency steps (more samples), or a range origin for "
                    "data that are centred on a scene",
                    "range_max",
                )
            step = self.waveform.max_range / round(oversample * self.waveform.samples)
        do = "give metres, and direction cosines, or less oversampling"
        farthest = max(range_max, -range_min)
        require_at_most(farthest / step, MAX_COUNT, "bins of range", do, "range_max")
        first = math.floor(range_min / step + 1e-9)
        last = math.ceil(range_max / step - 1e-9)
        axes = {}
        half = 0.5 * self.waveform.wavelength
        for name, limit, size in zip("uv", (u_max, v_max), self.aperture, strict=True):
            if size < 1.001 * half:
                continue
            spacing = self.waveform.wavelength / (2 * oversample * size)
            most = MAX_COUNT / 2 - 1
            require_at_most(limit / spacing, most, f"bins of {name}", do, f"{name}_max")
            side = min(math.ceil(limit / spacing - 1e-9), math.floor(1 / spacing + 1e-9))
            axes |= {f"{name}_start": -side * spacing, f"{name}_step": spacing}
            axes |= {f"{name}_count": 2 * side + 1}
        found = Grid(first * step, step, last - first + 1, **axes)
        do = "check units of the frequency and of the antennas' positions, or narrow the limits"
        require_at_most(math.prod(found.shape), _MAX_BINS, "bins", do, "range_max")
        return found

    @property
    def _rotations(self) -> Float64[Tensor, "frame 3 3"]:
        if self.rotations is not None:
            return self.rotations
        return torch.eye(3, dtype=torch.float64).expand(self.frame_count, 3, 3)

    @property
    def _shared_visibility(self) -> bool:
        if self.shared_visibility is not None:
            return self.shared_visibility
        tx, rx = self.transmitters.positions.mean(0), self.receivers.positions.mean(0)
        return bool((tx - rx).norm() <= _SHARED_VISIBILITY_DISTANCE)

    def _world(self, elements: Float64[Tensor, "n 3"]) -> Float64[Tensor, "frame n 3"]:
        return self.positions[:, None] + elements @ self._rotations.mT

    def _warn_about_spacing(self) -> None:
        wavelength = self.waveform.wavelength
        for axis, name in ((1, "y"), (2, "z")):
            places = torch.unique((self.virtual_positions[:, axis] / wavelength * 1e3).round())
            if len(places) < 2:
                continue
            spacing = float(places.diff().min()) / 1e3
            if spacing > 0.5 * _SPACING_TOLERANCE:
                warnings.warn(
                    f"virtual elements are {spacing:.2f} wavelengths apart along {name}, more "
                    "than 0.5: the spectrum repeats (grating lobes) within the field of view",
                    PhysicsWarning,
                    stacklevel=4,
                )


def require_sampled_waveform(radar: Radar) -> SampledWaveform:
    """Return the radar's waveform, or raise an error if it has no beat signal."""
    if isinstance(radar.waveform, SampledWaveform):
        return radar.waveform
    raise InputError(
        f"expected an FMCW, stepped frequency or OFDM radar, got {type(radar.waveform).__name__}, "
        "which has no beat signal; use the surrogate for it"
    )


def checked_beat(
    beat: Complex[Tensor, "frame tx rx sample"], radar: Radar
) -> Complex[Tensor, "frame tx rx sample"]:
    """Validate the shape of a beat signal.

    Args:
        beat: one signal per frame and channel.
        radar: radar that recorded it.

    Raises:
        InputError: A beat signal of another shape.
    """
    expected = (*radar.shape, require_sampled_waveform(radar).samples)
    what = "a beat signal (frame, tx, rx, sample)"
    checks.check_shape(beat, expected, what, "use the radar that recorded it")
    return beat


def _checked_origin(value: object, frames: int) -> Tensor:
    do = "give one range in metres per frame"
    origin = checks.checked_tensor(value, (frames,), "range_origin", do, MAX_LENGTH)
    do = "it is what the recording was compensated with: detach it"
    checks.refuse_derivatives(origin, "range_origin", do)
    return origin


def _checked_rotations(value: object, frames: int) -> Tensor:
    do = "its columns are the radar's x (boresight), y (left) and z (up) axes in the world"
    rotations = checks.checked_tensor(value, (frames, 3, 3), "radar rotations", do)
    fixed = rotations.detach()
    error = (fixed.mT @ fixed - torch.eye(3, dtype=torch.float64, device=fixed.device)).abs()
    if not (error.amax() < 1e-6 and (torch.linalg.det(fixed) > 0).all()):
        raise InputError(
            "expected radar rotations to be orthonormal with determinant +1, got matrices off by "
            f"up to {float(error.amax()):.2g} or mirrored; {do}"
        )
    return rotations
