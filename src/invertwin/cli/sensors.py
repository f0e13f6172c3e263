"""From the tables of a run file to sensors: radars, boards, grids, chirp trains, front ends."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from invertwin.channel import Grid
from invertwin.cli import schema
from invertwin.cli.run_file import about
from invertwin.errors import InputError
from invertwin.radar.boards import Board, board
from invertwin.radar.impairments import ADC, Impairments, Leakage, PhaseNoise
from invertwin.radar.motion import Chirps
from invertwin.radar.radar import Radar
from invertwin.radar.waveform import (
    FMCW,
    OFDM,
    Impulse,
    SampledWaveform,
    SteppedFrequency,
    Waveform,
)
from invertwin.scene import (
    AntennaArray,
    Cosine,
    Isotropic,
    Pattern,
    Table,
    linear_array,
    look_at,
    planar_array,
    rotation_from_vector,
)

_MOST_BINS = 1e9  # 4 GB a map


def radar(table: schema.Radar) -> Radar:
    """The radar of the `[radar]` table, one frame per position.

    Raises:
        InputError: Values the radar refuses, or a target straight above a position.
    """
    with about("radar.waveform"):
        waveform = _waveform(table.waveform)
    if table.board is not None:
        with about("radar.board"):
            transmitters, receivers = board_elements(table.board)
    else:
        assert table.transmitters is not None
        assert table.receivers is not None
        with about("radar.transmitters"):
            transmitters = _array(table.transmitters)
        with about("radar.receivers"):
            receivers = _array(table.receivers)
    positions = track(table.positions)
    with about("radar.orientation.look_at"):
        rotations = rotations_of(table.orientation, positions)
    with about("radar"):
        return Radar(
            transmitters,
            receivers,
            waveform,
            positions,
            rotations,
            window=table.window,
            array_window=table.array_window,
            shared_visibility=table.shared_visibility,
        )


def _waveform(table: schema.Waveform) -> Waveform:
    match table:
        case schema.Fmcw():
            return FMCW(table.start_frequency, table.bandwidth, table.duration, table.samples)
        case schema.SteppedFrequency():
            return SteppedFrequency(table.start_frequency, table.step, table.samples, table.dwell)
        case schema.Ofdm():
            return OFDM(table.start_frequency, table.spacing, table.subcarriers)
    return Impulse(table.center_frequency, table.bandwidth)


def board_elements(
    table: schema.Board,
    transmitters: Sequence[int] | None = None,
    receivers: Sequence[int] | None = None,
) -> tuple[AntennaArray, AntennaArray]:
    """TX and RX elements of a `board` table.

    Args:
        table: A preset or a table of one's own.
        transmitters: Numbers of those that recorded, in the order of sending; None = the table's.
        receivers: The same for RX.

    Raises:
        InputError: A missing sign, an element that the board does not have, or a choice of
            elements both in the table and by a recording.
    """
    for name, recorded in (("transmitters", transmitters), ("receivers", receivers)):
        given = getattr(table, name)
        if recorded is not None and given is not None:
            raise InputError(
                f"expected no `{name}` with a recording, got {given}; remove the key: the "
                f"recording's settings say {list(recorded)}"
            )
    if isinstance(table, schema.PresetBoard):
        chosen = board(table.name)
    else:
        places = [[(x, y) for x, y in end] for end in (table.tx_places, table.rx_places)]
        chosen = Board("the board", tuple(places[0]), tuple(places[1]), table.design_frequency)
    return chosen.arrays(
        elevation=table.elevation,
        azimuth=table.azimuth,
        design_frequency=table.design_frequency,
        transmitters=transmitters or table.transmitters,
        receivers=receivers or table.receivers,
        pattern=_pattern(table.pattern),
    )


def _array(table: schema.Array) -> AntennaArray:
    pattern = _pattern(table.pattern)
    match table:
        case schema.PlanarArray():
            array = planar_array(*table.count, *table.spacing, pattern=pattern)
        case schema.LinearArray():
            array = linear_array(table.count, table.spacing, table.axis, pattern=pattern)
        case _:
            array = AntennaArray(_float64(table.positions), pattern)
    return replace(array, positions=array.positions + _float64(table.center))


def _pattern(table: schema.Pattern) -> Pattern:
    match table:
        case schema.Cosine():
            return Cosine(table.exponent)
        case schema.TablePattern():
            theta, phi = torch.deg2rad(_float64(table.theta_deg)), _float64(table.phi_deg)
            return Table(theta, torch.deg2rad(phi), 10 ** (_float64(table.gain_db) / 10))
    return Isotropic()


def track(table: schema.Track) -> Tensor:
    """Positions [frame, 3] of a track."""
    match table:
        case schema.LineTrack():
            start, stop = _float64(table.start), _float64(table.stop)
            return start + torch.linspace(0, 1, table.count, dtype=torch.float64)[:, None] * (
                stop - start
            )
        case schema.ArcTrack():
            angle = torch.deg2rad(
                torch.linspace(table.start_deg, table.stop_deg, table.count, dtype=torch.float64)
            )
            around = torch.stack([angle.sin(), 0 * angle, -angle.cos()], dim=1)
            return _float64(table.center) + table.radius * around
        case schema.GridTrack():
            x, y = (
                (torch.linspace(-0.5, 0.5, n, dtype=torch.float64) if n > 1 else torch.zeros(1))
                * size
                for n, size in zip(table.count, table.size, strict=True)
            )
            across, up = torch.meshgrid(x.double(), y.double(), indexing="ij")
            offsets = torch.stack([across, up, torch.zeros_like(up)], dim=-1)
            return _float64(table.center) + offsets.reshape(-1, 3)
    return _float64(table)


def rotations_of(table: schema.Orientation, positions: Tensor) -> Tensor:
    """Columns are the radar's right, up and boresight axes in the world [frame, 3, 3].

    Raises:
        InputError: A target straight above a position.
    """
    if isinstance(table, schema.Turned):
        turn = rotation_from_vector(torch.deg2rad(_float64(table.rotation_deg)))
        return turn.expand(len(positions), 3, 3).clone()
    return look_at(positions, table.look_at)


def grid(table: schema.Grid, radar: Radar) -> Grid:
    """The bins of the `[grid]` table for a radar.

    Raises:
        InputError: Limits that the radar refuses or does not reach, or a map of a size that only
            a wrong unit explains.
    """
    wave = radar.waveform
    if isinstance(wave, SampledWaveform) and table.range_max > wave.max_range:
        raise InputError(
            f"grid.range_max: expected at most the waveform's unambiguous range, "
            f"{wave.max_range:.4g} m, got {table.range_max:g}; give metres, or more samples"
        )
    with about("grid"):
        found = radar.grid(
            table.range_min, table.range_max, table.u_max, table.v_max, oversample=table.oversample
        )
    bins = math.prod(found.shape) * radar.frame_count
    if bins > _MOST_BINS:
        raise InputError(
            f"grid: expected a map of at most {_MOST_BINS:g} bins over all frames, got {bins:.3g}; "
            "give limits in metres and direction cosines, or less oversampling"
        )
    return found


def chirps(table: schema.Chirps) -> Chirps:
    """Timing of the `[chirps]` table."""
    return Chirps(table.count, table.interval, tdm=table.tdm)


def impairments(table: schema.Impairments, data: schema.SimulatedData) -> Impairments:
    """The front end of the `[impairments]` table, with the noise of the `[data]` table.

    Raises:
        InputError: Values that no front end has.
    """
    noise, leak, adc = table.phase_noise, table.leakage, table.adc
    with about("impairments"):
        return Impairments(
            None if noise is None else PhaseNoise(tuple(noise.offsets), tuple(noise.levels)),
            None if leak is None else Leakage(leak.delay, leak.level_db),
            gain_std_db=table.gain_std_db,
            phase_std=math.radians(table.phase_std_deg),
            snr_db=data.snr_db,
            noise_figure_db=data.noise_figure_db,
            transmit_power=table.transmit_power,
            adc=None if adc is None else ADC(adc.bits, adc.full_scale),
        )


def _float64(values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)
