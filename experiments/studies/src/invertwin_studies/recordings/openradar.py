"""Reader for a public recording of a 77 GHz board with two transmitters.

``openradar.npz`` (github.com/PreSenseRadar/OpenRadar, Apache-2.0): one frame of 128 loops, 2 TX in
turn × 4 RX, 128 complex samples at 2.5 MS/s; people move at about 3 m. Nothing was surveyed.
"""

import json
from pathlib import Path

import torch

from invertwin.capture.chirps import ChirpData, ChirpSettings
from invertwin.errors import InputError
from invertwin.storage.untrusted import read_arrays

FILE = "openradar.npz"
_TX, _RX = 2, 4


def read_chirps(folder: str | Path) -> ChirpData:
    """Every chirp of the recording, in ADC counts.

    The frequency in the file is taken as that of the first sample: the ADC's start is not recorded.

    Raises:
        InputError: no file, a damaged one, an array of another shape, or no settings.
    """
    arrays = read_arrays(Path(folder) / FILE, "it is damaged or truncated: copy it again")
    frame = arrays.get("frame_2tx4rx")
    if frame is None or frame.ndim != 3 or frame.shape[1] != _TX * _RX or frame.dtype.kind != "c":
        got = "none" if frame is None else f"{frame.dtype} of shape {frame.shape}"
        raise InputError(
            f"expected complex frame_2tx4rx of shape (chirps, {_TX * _RX}, samples), got {got}; "
            "take the file from its public original"
        )
    try:
        meta = json.loads(str(arrays["meta"]))
        settings = ChirpSettings(
            start_frequency=float(meta["f0_hz"]),
            slope=float(meta["slope_hz_s"]),
            sample_rate=float(meta["fs_hz"]),
            samples=frame.shape[2],
            transmit_order=(1, 2),
            receivers=(1, 2, 3, 4),
            loops=frame.shape[0],
            frames=1,
            idle_time=float(meta["idle_s"]),
            ramp_end_time=float(meta["ramp_end_s"]),
        )
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        raise InputError(
            f"expected meta with f0, slope, sample rate, idle and ramp end time, got one without "
            f"({error}); take the file from its public original"
        ) from error
    samples = frame.reshape(1, len(frame), _TX, _RX, frame.shape[2])
    data = ChirpData(torch.from_numpy(samples.copy()), settings)
    data.warn_if_saturated()
    return data
