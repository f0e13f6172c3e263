"""Measured data in and out: captures, their files, readers, and backprojection."""

import difflib
from collections.abc import Callable
from pathlib import Path
from types import MappingProxyType
from typing import Any

from invertwin.capture import described_arrays, ti
from invertwin.capture.backprojection import backproject, calibrate, locate
from invertwin.capture.capture import Capture
from invertwin.capture.channels import ChannelCalibration, estimate_channels
from invertwin.capture.chirp_capture import ChirpCapture
from invertwin.capture.chirps import ChirpData, ChirpSettings, adc_counts, settings_of
from invertwin.capture.track import Track
from invertwin.errors import InputError

READERS: MappingProxyType[str, Callable[..., Capture]] = MappingProxyType(
    {
        "netcdf": Capture.load,
        "dca1000": ti.read,
        "arrays": described_arrays.read,
    }
)
"""Name → function that takes a path, and options of its own, and returns a `Capture`."""


def read(path: str | Path, reader: str = "netcdf", **options: Any) -> Capture:
    """Reads a capture with one of `READERS`.

    Args:
        path: file or folder, as the reader expects it.
        reader: its name.
        options: passed on to the reader.

    Raises:
        InputError: an unknown reader, or what the reader raises.
    """
    if reader not in READERS:
        near = difflib.get_close_matches(reader, READERS, n=1, cutoff=0.0)[0]
        raise InputError(
            f"expected a reader of {', '.join(READERS)}, got {reader!r}; did you mean {near!r}?"
        )
    return READERS[reader](path, **options)


__all__ = [
    "READERS",
    "Capture",
    "ChannelCalibration",
    "ChirpCapture",
    "ChirpData",
    "ChirpSettings",
    "Track",
    "adc_counts",
    "backproject",
    "calibrate",
    "estimate_channels",
    "locate",
    "read",
    "settings_of",
]
