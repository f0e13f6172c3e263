"""Limits of devices, and the times that a board needs where settings state none."""

import math
from dataclasses import replace

from invertwin.capture.chirps import ChirpSettings
from invertwin.capture.ti.chirp_table import FIELDS, device_family

_BAND_EDGE = 70e9  # Hz, between the devices of 60 and 77 GHz
_PAUSE = FIELDS["limits"]["pause after the chirps of a frame [ms]"]


def recording_family(chirp_settings: ChirpSettings, device: str = "") -> str:
    """First two digits of the device, or of one with the lanes and the band of the settings.

    Args:
        chirp_settings: of a recording.
        device: name of a board; none = not known.
    """
    near = "68" if chirp_settings.start_frequency < _BAND_EDGE else "18"
    return device_family(device) or ("14" if chirp_settings.lanes == 4 else near)


def add_demo_times(chirp_settings: ChirpSettings, device: str = "") -> ChirpSettings:
    """Settings with the times of the SDK's demos where they are 0 or not stated.

    The sampled part of the ramp and the time from ramp to ramp stay: an ADC start time is taken
    from the idle time above that of the demos, as far as the band of the device reaches. The
    frame period is the shortest number of whole milliseconds that holds the chirps.

    Args:
        chirp_settings: of a recording.
        device: name of a board; none = one with the lanes and the band of the settings.
    """
    s, demo = chirp_settings, FIELDS["demo"]
    bands = FIELDS["devices"][recording_family(s, device)]["bands"]
    end = s.start_frequency + s.slope * s.ramp_time
    room = max((s.start_frequency - b[0] for b in bands if end <= b[1]), default=0.0) / s.slope
    delay = min(demo["adc_start_time"], s.idle_time - demo["idle_time"], room)
    if s.adc_start_time == 0 and (delay := math.floor(delay * 1e7) / 1e7) > 0:
        s = replace(
            s,
            start_frequency=s.start_frequency - s.slope * delay,
            adc_start_time=delay,
            idle_time=round(s.idle_time - delay, 9),
            ramp_end_time=s.ramp_end_time and s.ramp_end_time + delay,
        )
    period = math.ceil(frame_duration(s) * 1e3 + _PAUSE[0]) / 1e3
    return s if s.frame_period else replace(s, frame_period=period)


def frame_duration(chirp_settings: ChirpSettings) -> float:
    """Time of the chirps of a frame, with their idle times [s]."""
    s = chirp_settings
    return s.loops * len(s.transmit_order) * (s.idle_time + s.ramp_time)


def describe_excess(chirp_settings: ChirpSettings, family: str) -> list[str]:
    """Values of the settings that a device cannot have, each with its limits.

    Args:
        chirp_settings: of a recording.
        family: first two digits of the device.
    """
    s, device = chirp_settings, FIELDS["devices"][family]
    kind, parts = ("real", 1) if s.real else ("complex", 2)
    start, end = (f / 1e9 for f in (s.start_frequency, s.start_frequency + s.slope * s.ramp_time))
    fitting = [b for b in device["bands"] if b[0] <= s.start_frequency]
    band = [f / 1e9 for f in max(fitting, default=device["bands"][0])]
    values = {
        "start frequency [GHz]": start,
        "end of the ramp [GHz]": end,
        "slope [MHz/µs]": s.slope / 1e12,
        f"rate of {kind} samples [Msps]": s.sample_rate / 1e6,
        "memory of a chirp [byte]": 2 * parts * s.samples * len(s.receivers),
        "number of a transmitter": max(s.transmit_order),
        "number of a receiver": max(s.receivers),
        "idle time [µs]": s.idle_time * 1e6,
        "ADC start time [µs]": s.adc_start_time * 1e6,
        "ramp [µs]": s.ramp_time * 1e6,
        "loops": s.loops,
        "frames": s.frames or 0,
        "pause after the chirps of a frame [ms]": 1e3 * ((s.frame_period or 0) - frame_duration(s)),
    }
    limits = FIELDS["limits"] | device["limits"]
    limits |= {"start frequency [GHz]": band, "end of the ramp [GHz]": band}
    return [
        f"{name} is {value:.6g}, not {limits[name][0]:g} to {limits[name][1]:g}"
        for name, value in values.items()
        if not limits[name][0] * (1 - 1e-9) <= value <= limits[name][1] * (1 + 1e-9)
    ]
