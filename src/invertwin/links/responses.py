"""Channel responses of paths over frequency, over delay, and over symbols and subcarriers.

A path adds ``a exp(−j2πfτ)``. The delay at an element of an array is shorter by (u·p)/c, with u the
direction of the path at the array and p the element's position: arrays must be small compared with
path lengths. For larger arrays, trace the elements as separate antennas.
"""

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Complex128, Float64, Int64
from torch import Tensor

from invertwin import checks
from invertwin.channel import RayPaths, polarisations
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.runtime.memory import require_memory
from invertwin.scene import AntennaArray
from invertwin.scene.material.fresnel import safe_root

_VALUES_PER_CHUNK = 1 << 21
_UP = (0.0, 0.0, 1.0)  # of V in ``RayPaths``, and in the frame of an array
_ROTATION_STEP = 1e-4  # rad: half the step over which fields of antennas are compared


def _world_axes() -> Tensor:
    return torch.eye(3, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class AntennaMount:
    """Antenna array mounted at each position of transmitters, or of receivers.

    V and H of the array's polarisation are about its z axis. By default, a mount has one isotropic
    element with polarisation V, and the world's axes: its boresight is x.

    Attributes:
        array: Antenna array; element positions are relative to the position of the mount.
        rotations: Rotation matrices whose columns are the array's x (boresight), y and z axes in
            the world: one for all positions [3, 3], or one for each [position, 3, 3].

    Raises:
        InputError: Rotations of a wrong shape, or not orthonormal.
    """

    array: AntennaArray = field(default_factory=lambda: AntennaArray(torch.zeros(1, 3).double()))
    rotations: Float64[Tensor, "*place 3 3"] = field(default_factory=_world_axes)

    def __post_init__(self) -> None:
        do = "give the axes as columns, for all or for each place"
        given = checks.to_tensor(self.rotations, "rotations of terminals", do)
        shape = (3, 3) if given.ndim < 3 else (None, 3, 3)
        turns = checks.checked_tensor(given, shape, "rotations of terminals", do)
        checks.check_orthonormal(turns, "rotations of terminals", do)
        checks.set_fields(self, rotations=turns)

    def element_weights(
        self, direction: Float64[Tensor, "path 3"], index: Int64[Tensor, " path"]
    ) -> Complex128[Tensor, "path element 2"]:
        """Compute the field of each element along directions, over V and H of ``RayPaths``.

        Args:
            direction: Unit vectors in the world, away from the terminal.
            index: Its number.
        """
        return self._turned_weights(direction, self._rotations_of(index))

    def _turned_weights(self, direction: Tensor, turn: Tensor) -> Tensor:
        local = torch.einsum("pij,pi->pj", turn, direction)
        gain = self.array.pattern.gain(local)
        strength = safe_root(gain, 0.0)
        up = torch.tensor(_UP, dtype=torch.float64, device=direction.device)
        own, basis = polarisations(local, up), polarisations(direction, up)
        change = torch.einsum("pwi,pij,pbj->pwb", basis, turn, own).to(torch.complex128)
        jones = self.array.jones
        mixed = jones.evaluate(local).to(change).expand(len(local), -1, -1)
        weights = torch.einsum("pwb,ek,pkb->pew", change, jones.mixtures.to(change), mixed)
        return strength[:, None, None] * weights

    def element_slopes(
        self,
        direction: Float64[Tensor, "path 3"],
        index: Int64[Tensor, " path"],
        axis: Float64[Tensor, "path 3"],
        wave_number: float,
        zone: Float64[Tensor, " path"],
    ) -> Complex128[Tensor, "path element 2"]:
        """Derivative of the field of each element with respect to rotations about axes [1/rad].

        The field vectors rotate with the directions: the derivative of a field that is symmetric
        about an axis is zero. Phases from element to element are included.

        In the far zone of an antenna, its field changes across the first Fresnel zone by less than
        its peak. Where a model changes faster, as the polarisation V of an isotropic element about
        the z axis of its array, the derivative is attenuated: it vanishes on that axis.

        Args:
            direction: Unit vectors in the world, away from the terminal.
            index: Its number.
            axis: Unit vectors in the world.
            wave_number: k [1/m].
            zone: Radius of the first Fresnel zone about each direction [rad].
        """
        turn = self._rotations_of(index)
        # An antenna that turns back has the field of a direction that turns, in the basis here. A
        # difference works in every mode of differentiation, and for patterns that are tables.
        generator = torch.linalg.cross(axis[:, None], _world_axes().to(axis.device)[None])
        back = torch.linalg.matrix_exp(_ROTATION_STEP * generator)
        later, earlier = (self._turned_weights(direction, by @ turn) for by in (back, back.mT))
        slope = (later - earlier) / (2 * _ROTATION_STEP)
        change = (zone[:, None, None] * torch.view_as_real(slope).flatten(2)).square().sum(2)
        peak = self.array.pattern.table().max().clamp_min(1e-300).to(change.device)
        slope = slope * (peak / torch.maximum(change, peak))[..., None]
        moved = torch.linalg.cross(axis, direction)
        ahead = 1j * wave_number * self.element_advances(moved, index)[..., None]
        return slope + ahead * self.element_weights(direction, index)

    def element_advances(
        self, direction: Float64[Tensor, "path 3"], index: Int64[Tensor, " path"]
    ) -> Float64[Tensor, "path element"]:
        """Path length to the origin of the array minus that to each element [m].

        Args:
            direction: Unit vectors in the world, away from the terminal.
            index: Its number.
        """
        places = self.array.positions.to(direction.device)
        return torch.einsum("pij,ej,pi->pe", self._rotations_of(index), places, direction)

    def _rotations_of(self, index: Tensor) -> Tensor:
        rotations = self.rotations.to(index.device)
        if rotations.ndim == 2:
            return rotations.expand(len(index), 3, 3)
        if len(index) and int(index.max()) >= len(self.rotations):
            raise InputError(
                f"expected a rotation for each of {int(index.max()) + 1} places or more, got "
                f"{len(self.rotations)}; give one for all, or one for each"
            )
        return rotations[index]


DEFAULT_MOUNT = AntennaMount()


def path_amplitudes(
    paths: RayPaths, tx: AntennaMount = DEFAULT_MOUNT, rx: AntennaMount = DEFAULT_MOUNT
) -> tuple[Complex128[Tensor, "path rx_ant tx_ant"], Float64[Tensor, "path rx_ant tx_ant"]]:
    """Compute coefficient and delay [s] of every path between every pair of elements.

    Args:
        paths: Paths from ``trace_paths``.
        tx: Antenna mount of the transmitters.
        rx: Antenna mount of the receivers.
    """
    sent = tx.element_weights(paths.departure, paths.tx)
    received = rx.element_weights(paths.arrival, paths.rx)
    amplitude = torch.einsum("pri,pij,ptj->prt", received, paths.coefficient, sent)
    if paths.slopes is not None and paths.axes is not None:
        amplitude = amplitude + _slope_diffraction(paths, paths.slopes, paths.axes, tx, rx)
    ahead = rx.element_advances(paths.arrival, paths.rx)[:, :, None]
    ahead = ahead + tx.element_advances(paths.departure, paths.tx)[:, None]
    return amplitude, paths.delay[:, None, None] - ahead / SPEED_OF_LIGHT


def _slope_diffraction(
    paths: RayPaths, slopes: Tensor, axes: Tensor, tx: AntennaMount, rx: AntennaMount
) -> Tensor:
    """Slope diffraction: the contribution of edges to fields that vary across the rays."""
    rows = torch.nonzero(axes.detach().flatten(1).abs().amax(1) > 0)[:, 0]
    k = 2 * math.pi * paths.frequency / SPEED_OF_LIGHT
    ways, places = (paths.departure[rows], paths.arrival[rows]), (paths.tx[rows], paths.rx[rows])
    # On a shadow boundary |∂D/∂φ′| = √(2kL/π) |D|: slope over coefficient is the radius over π.
    zones = math.pi * torch.linalg.matrix_norm(slopes[rows])
    zones = zones / torch.linalg.matrix_norm(paths.coefficient[rows]).clamp_min(1e-300)[:, None]
    ends = list(zip((tx, rx), ways, places, axes[rows].unbind(1), zones.unbind(1), strict=True))
    even = [end.element_weights(way, place) for end, way, place, *_ in ends]
    uneven = [end.element_slopes(way, place, axis, k, zone) for end, way, place, axis, zone in ends]
    by_tx, by_rx = slopes[rows].unbind(1)
    added = torch.einsum("pri,pij,ptj->prt", even[1], by_tx, uneven[0])
    added = added + torch.einsum("pri,pij,ptj->prt", uneven[1], by_rx, even[0])
    return added.new_zeros(len(paths), *added.shape[1:]).index_add(0, rows, added)


def frequency_response(
    paths: RayPaths,
    frequencies: checks.ArrayLike,
    *,
    tx: AntennaMount = DEFAULT_MOUNT,
    rx: AntennaMount = DEFAULT_MOUNT,
) -> Complex128[Tensor, "rx rx_ant tx tx_ant frequency"]:
    """Frequency response H(f) = Σ a exp(−j2πfτ) between all elements; zero without a path.

    Delays are exact at all frequencies; coefficients are those at ``paths.frequency``. For a wide
    band, trace at several frequencies.

    Args:
        paths: Paths from ``trace_paths``.
        frequencies: One or several frequencies, in any order [Hz].
        tx: Antenna mount of the transmitters.
        rx: Antenna mount of the receivers.

    Raises:
        InputError: No frequency, or a frequency that is not finite.
    """
    swept, start = checked_frequencies(frequencies), torch.zeros(1, dtype=torch.float64)
    return _evaluate_responses(paths, swept, start, tx, rx)[..., 0, :]


def checked_frequencies(frequencies: checks.ArrayLike) -> Float64[Tensor, " frequency"]:
    """Check one or several frequencies [Hz] and return them as a vector."""
    swept = torch.atleast_1d(torch.as_tensor(frequencies, dtype=torch.float64))
    return checks.checked_tensor(swept, (None,), "frequencies [Hz]", "give one or several")


def ofdm_channel(
    paths: RayPaths,
    *,
    subcarriers: int,
    spacing: float,
    symbols: int = 1,
    cyclic_prefix: float = 0.0,
    tx: AntennaMount = DEFAULT_MOUNT,
    rx: AntennaMount = DEFAULT_MOUNT,
) -> Complex128[Tensor, "rx rx_ant tx tx_ant symbol subcarrier"]:
    """Channel coefficients of every OFDM symbol and subcarrier.

    Subcarriers are centred: subcarrier k has the frequency
    ``paths.frequency + (k − N//2) · spacing``. The symbol period is 1/spacing plus the cyclic
    prefix, which is assumed long enough for all paths. Paths are static within a symbol; from
    symbol to symbol, phases rotate by Doppler shifts, in proportion to each subcarrier's frequency.

    Args:
        paths: Paths from ``trace_paths``.
        subcarriers: Number N of subcarriers.
        spacing: Spacing of subcarriers [Hz].
        symbols: Number of symbols.
        cyclic_prefix: Duration of the cyclic prefix [s].
        tx: Antenna mount of the transmitters.
        rx: Antenna mount of the receivers.

    Raises:
        InputError: A number out of range.
    """
    count = checks.checked_count(subcarriers, "subcarriers", 1)
    step = checks.checked_number(spacing, "subcarrier spacing [Hz]", 0.0, open_low=True)
    prefix = checks.checked_number(cyclic_prefix, "cyclic prefix [s]", 0.0)
    instants = checks.checked_count(symbols, "symbols", 1)
    _require_channel_memory(paths, count * instants, tx, rx)
    number = torch.arange(instants, dtype=torch.float64)
    grid = torch.arange(count, dtype=torch.float64) - count // 2
    swept, times = paths.frequency + grid * step, number * (1 / step + prefix)
    return _evaluate_responses(paths, swept, times, tx, rx)


def impulse_response(
    paths: RayPaths,
    *,
    bandwidth: float,
    taps: int,
    start: float = 0.0,
    tx: AntennaMount = DEFAULT_MOUNT,
    rx: AntennaMount = DEFAULT_MOUNT,
) -> Complex128[Tensor, "rx rx_ant tx tx_ant tap"]:
    """Impulse response in a band about the carrier: h_n = Σ a exp(−j2πf₀τ) sinc(B(τ − t_n)).

    Taps are at t_n = start + n/B. For delays and amplitudes of paths without a band limit, see
    ``path_amplitudes``.

    Args:
        paths: Paths from ``trace_paths``.
        bandwidth: Bandwidth B [Hz].
        taps: Number of taps.
        start: Delay of the first tap [s].
        tx: Antenna mount of the transmitters.
        rx: Antenna mount of the receivers.

    Raises:
        InputError: A number out of range.
    """
    band = checks.checked_number(bandwidth, "bandwidth [Hz]", 0.0, open_low=True)
    count = checks.checked_count(taps, "taps", 1)
    first = checks.checked_number(start, "start [s]", -math.inf)
    amplitude, delay = path_amplitudes(paths, tx, rx)
    turned = amplitude * phasor(-paths.frequency * delay)
    shape = (len(paths), *amplitude.shape[1:], count)
    require_memory(16.0 * math.prod(shape), "an impulse response", "ask for fewer taps", "taps")
    times = first + torch.arange(count, dtype=torch.float64, device=delay.device) / band
    return _sum_by_link(paths, turned[..., None] * torch.sinc(band * (delay[..., None] - times)))


def _evaluate_responses(
    paths: RayPaths, frequencies: Tensor, times: Tensor, tx: AntennaMount, rx: AntennaMount
) -> Tensor:
    """H over [rx, rx_ant, tx, tx_ant, time, frequency]."""
    checks.check_some(frequencies, "frequency", "give one or several [Hz]")
    amplitude, delay = path_amplitudes(paths, tx, rx)
    _require_channel_memory(paths, len(times) * len(frequencies), tx, rx)
    pairs = amplitude.shape[1] * amplitude.shape[2]
    # Delays change with time: a Doppler shift ν of the carrier f₀ is dτ/dt = −ν/f₀.
    rate = -paths.doppler / paths.frequency
    frequencies, times = frequencies.to(delay.device), times.to(delay.device)
    parts = []
    chunk = max(1, _VALUES_PER_CHUNK // max(1, len(paths) * pairs * len(times)))
    for some in frequencies.split(chunk):
        moved = times[:, None] * rate[:, None, None, None, None]
        turn = phasor(-some * (delay[..., None, None] + moved))
        parts.append(_sum_by_link(paths, amplitude[..., None, None] * turn))
    return torch.cat(parts, -1)


def _require_channel_memory(
    paths: RayPaths, count: int, tx: AntennaMount, rx: AntennaMount
) -> None:
    """Refuse a channel that does not fit into the memory."""
    elements = len(tx.array.positions) * len(rx.array.positions)
    values = float(paths.counts[0] * paths.counts[1] * elements) * count
    # Parts of 16 bytes each, and all of them once more when they are joined.
    require_memory(32 * values, "a channel", "ask for fewer frequencies, symbols or elements")


def _sum_by_link(paths: RayPaths, values: Tensor) -> Tensor:
    """Sum values [path, rx_ant, tx_ant, …] over the paths of each link, receivers first."""
    return sum_over_paths(paths, values).movedim((1, 2, 0, 3), (0, 1, 2, 3))


def sum_over_paths(
    paths: RayPaths, values: Float64[Tensor, "path *value"] | Complex128[Tensor, "path *value"]
) -> Float64[Tensor, "tx rx *value"] | Complex128[Tensor, "tx rx *value"]:
    """Sum values of paths over each link.

    Args:
        paths: Paths.
        values: One or several numbers per path.
    """
    total = values.new_zeros(paths.counts[0] * paths.counts[1], *values.shape[1:])
    return total.index_add(0, paths.link, values).unflatten(0, paths.counts)


def phasor(cycles: Float64[Tensor, "*any"]) -> Complex128[Tensor, "*any"]:
    """Phasor exp(j2π cycles), computed without the whole cycles.

    Args:
        cycles: Phases over 2π.
    """
    angle = 2 * math.pi * (cycles - cycles.detach().round())
    return torch.polar(torch.ones_like(angle), angle)
