"""Paths as text."""

import math

import torch

from invertwin.channel import KINDS, RayPaths
from invertwin.links.responses import DEFAULT_MOUNT, AntennaMount, path_amplitudes

_HEADER = (
    f"{'path':>4} {'delay ns':>10} {'length m':>10} {'power dB':>9} {'departs az, el':>16} "
    f"{'arrives az, el':>16} {'Doppler Hz':>11}  what it meets"
)


def path_table(
    paths: RayPaths,
    link: tuple[int, int] = (0, 0),
    tx: AntennaMount = DEFAULT_MOUNT,
    rx: AntennaMount = DEFAULT_MOUNT,
) -> str:
    """Format the paths of one link as text, shortest first.

    Powers are ratios of received to transmitted power of the first elements. Directions are azimuth
    and elevation in the world in degrees, x towards y and up to z.

    Args:
        paths: Paths from ``trace_paths``.
        link: Indices of transmitter and receiver.
        tx: Antenna mount of the transmitters.
        rx: Antenna mount of the receivers.
    """
    some = paths.select_link(*link)
    amplitude, _ = path_amplitudes(some, tx, rx)
    power = 20 * torch.log10(amplitude.detach()[:, 0, 0].abs().clamp_min(1e-30))
    lines = [_HEADER]
    for row in range(len(some)):
        met = [
            f"{KINDS[kind]} {some.names[item] if 0 <= item < len(some.names) else '?'}"
            for kind, item in zip(some.kinds[row].tolist(), some.objects[row].tolist(), strict=True)
            if kind
        ]
        lines.append(
            f"{row:>4} {1e9 * some.delay[row].item():>10.3f} {some.length[row].item():>10.3f} "
            f"{power[row].item():>9.2f} {_format_angles(some.departure[row].tolist()):>16} "
            f"{_format_angles(some.arrival[row].tolist()):>16} {some.doppler[row].item():>11.2f}  "
            f"{', '.join(met) or 'line of sight'}"
        )
    return "\n".join(lines)


def _format_angles(direction: list[float]) -> str:
    x, y, z = direction
    azimuth = math.degrees(math.atan2(y, x))
    return f"{azimuth:.2f}, {math.degrees(math.atan2(z, math.hypot(x, y))):.2f}"
