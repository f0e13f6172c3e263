"""Reader for a public recording of an impulse radar on a rail.

``bwsi_rail_trial6.npz`` (github.com/jjimmykang/bwsi-backprojection, trial 6): a PulsON 440,
3.1–4.8 GHz, whose range waveforms are real samples at radio frequency, and the motion-capture track
of the radar.
"""

import json
from pathlib import Path

import numpy as np
import torch
from scipy.signal import hilbert

from invertwin.capture.capture import Capture
from invertwin.capture.track import Track
from invertwin.errors import InputError
from invertwin.radar.radar import Radar
from invertwin.radar.waveform import Impulse
from invertwin.scene.antenna import AntennaArray
from invertwin.storage.untrusted import read_arrays

FILE = "bwsi_rail_trial6.npz"

WAVEFORM = Impulse(center_frequency=3.95e9, bandwidth=1.5e9)
"""Middle of the nominal band 3.1–4.8 GHz. The bandwidth is the one whose range cell, c/2B = 0.10 m,
is the half-power width of the echo of reflector 1; the nominal 1.7 GHz would give 0.09 m."""

_DIMENSIONS = {
    "scan_data": 2,
    "scan_timestamps": 1,
    "range_bins": 1,
    "motion_timestamps": 1,
    "platform_pos": 2,
    "corner_reflector_pos": 2,
    "meta": 0,
}


def read(
    folder: str | Path, clock_offset: float | None = None, range_bias: float | None = None
) -> Capture:
    """Range profiles of the scans during which the radar moved.

    Scan times are seconds since the first scan. The scans become analytic signals along range;
    then their mean over the scans, the echo of everything that does not change, is removed. The
    radar's position at a scan is the track's at scan time + clock offset. The rail runs along −y
    and the antenna looks along +x, so that the track's axes are the radar's.

    Args:
        folder: where the file lies.
        clock_offset: track clock minus scan clock [s]; None = as recorded with the data.
        range_bias: what the radar's ranges are too long by [m]; None = as recorded with the data.

    Raises:
        InputError: no file, a damaged one, arrays of wrong shapes or with NaN.
    """
    arrays = _arrays(Path(folder) / FILE)
    meta = _meta(arrays)
    scans = arrays["scan_data"].astype(np.float64)
    milliseconds = arrays["scan_timestamps"].astype(np.float64)
    clock = (milliseconds - milliseconds[0]) / 1e3
    start, end = meta["valid_scan_time_s"]
    valid = (clock >= start) & (clock <= end)
    if not valid.any():
        raise InputError(
            f"expected scans between {start:g} and {end:g} s, got none; check the time stamps"
        )
    profile = np.asarray(hilbert(scans[valid], axis=1))
    profile -= profile.mean(axis=0)
    track = Track(
        torch.from_numpy(arrays["motion_timestamps"].astype(np.float64)),
        torch.from_numpy(arrays["platform_pos"].astype(np.float64)),
    )
    clock_offset = meta["align_time_offset_s"] if clock_offset is None else clock_offset
    range_bias = meta["align_range_bias_m"] if range_bias is None else range_bias
    times = torch.from_numpy(clock[valid])
    positions = track.interpolate(times + clock_offset)
    antenna = AntennaArray(torch.zeros(1, 3, dtype=torch.float64))
    return Capture.from_range_profile(
        torch.from_numpy(profile),
        torch.from_numpy(arrays["range_bins"].astype(np.float64)) - range_bias,
        Radar(antenna, antenna, WAVEFORM, positions),
        times,
        track=track,
        clock_offset=clock_offset,
        range_bias=range_bias,
        survey=torch.from_numpy(arrays["corner_reflector_pos"].astype(np.float64)),
    )


def _arrays(path: Path) -> dict[str, np.ndarray]:
    arrays = read_arrays(path, "it is damaged or truncated: copy it again")
    for name, dimensions in _DIMENSIONS.items():
        if name not in arrays or arrays[name].ndim != dimensions:
            got = f"shape {arrays[name].shape}" if name in arrays else "none"
            raise InputError(
                f"expected an array {name} with {dimensions} dimensions in {path}, got {got}; "
                "take the file from its public original"
            )
    for rows, columns, other in (
        ("scan_data", "range_bins", "scan_timestamps"),
        ("platform_pos", None, "motion_timestamps"),
    ):
        width = 3 if columns is None else len(arrays[columns])
        expected = (len(arrays[other]), width)
        if arrays[rows].shape != expected:
            raise InputError(
                f"expected {rows} of shape {expected}, got {arrays[rows].shape}; "
                "take the file from its public original"
            )
    return arrays


def _meta(arrays: dict[str, np.ndarray]) -> dict:
    try:
        meta = json.loads(str(arrays["meta"]))
        numbers = {key: float(meta[key]) for key in ("align_time_offset_s", "align_range_bias_m")}
        start, end = meta["valid_scan_time_s"]
        return numbers | {"valid_scan_time_s": (float(start), float(end))}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"expected meta with clock offset, range bias and valid times, got one without "
            f"({error}); take the file from its public original"
        ) from error
