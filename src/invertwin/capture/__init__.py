"""Measured data in and out: captures, their files, readers, and backprojection."""

import difflib
from collections.abc import Callable
from pathlib import Path
from types import MappingProxyType
from typing import Any

from invertwin.capture import described_arrays, ti
from invertwin.capture.backprojection import backproject as backproject
from invertwin.capture.backprojection import calibrate as calibrate
from invertwin.capture.backprojection import locate as locate
from invertwin.capture.capture import Capture as Capture
from invertwin.capture.channels import ChannelCalibration as ChannelCalibration
from invertwin.capture.channels import estimate_channels as estimate_channels
from invertwin.capture.chirp_capture import ChirpCapture as ChirpCapture
from invertwin.capture.chirps import ChirpData as ChirpData
from invertwin.capture.chirps import ChirpSettings as ChirpSettings
from invertwin.capture.chirps import adc_counts as adc_counts
from invertwin.capture.chirps import settings_of as settings_of
from invertwin.capture.track import Track as Track
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
