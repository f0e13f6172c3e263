"""Spreads of power over delays and directions."""

from typing import Literal

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.channel import KINDS, RayPaths
from invertwin.checks import check_choice
from invertwin.links.responses import DEFAULT_MOUNT, AntennaMount, path_amplitudes, sum_over_paths
from invertwin.scene.material.fresnel import safe_root


def delay_spread(
    paths: RayPaths, tx: AntennaMount = DEFAULT_MOUNT, rx: AntennaMount = DEFAULT_MOUNT
) -> Float64[Tensor, "rx tx"]:
    """Root-mean-square delay spread, weighted by power [s]; 0 for links of at most one path.

    Args:
        paths: Paths from ``trace_paths``.
        tx: Antenna mount of the transmitters.
        rx: Antenna mount of the receivers.
    """
    return _spread(paths, paths.delay[:, None], tx, rx)


def angle_spread(
    paths: RayPaths,
    end: Literal["departure", "arrival"] = "arrival",
    tx: AntennaMount = DEFAULT_MOUNT,
    rx: AntennaMount = DEFAULT_MOUNT,
) -> Float64[Tensor, "rx tx"]:
    """Angular spread √(1 − |u|²), with u the mean unit vector weighted by power.

    The spread is 0 for a single direction and 1 for a uniform distribution; for a narrow
    distribution it is the root-mean-square angle [rad]. It does not depend on axes.

    Args:
        paths: Paths from ``trace_paths``.
        end: End of the paths whose directions are used.
        tx: Antenna mount of the transmitters.
        rx: Antenna mount of the receivers.

    Raises:
        InputError: Another end.

    Source: Fleury, "First- and second-order characterization of direction dispersion and space
    selectivity in the radio channel", IEEE Trans. Information Theory 46, 2000.
    """
    check_choice(end, ("departure", "arrival"), "end as")
    return _spread(paths, getattr(paths, end), tx, rx)


def _spread(paths: RayPaths, values: Tensor, tx: AntennaMount, rx: AntennaMount) -> Tensor:
    """Root mean square distance of vectors from their mean, which does not cancel as 1 − |u|²."""
    power = path_powers(paths, tx, rx)
    total = _nonzero(_sum_links(paths, power))
    mean = torch.stack([_sum_links(paths, power * x) for x in values.unbind(1)], -1)
    mean = mean / total[..., None]
    offset = (values - mean[paths.rx, paths.tx]).square().sum(1)
    return safe_root(_sum_links(paths, power * offset) / total, 0.0)


def rician_factor(
    paths: RayPaths, tx: AntennaMount = DEFAULT_MOUNT, rx: AntennaMount = DEFAULT_MOUNT
) -> Float64[Tensor, "rx tx"]:
    """Power ratio of the straight path, also through sheets, to all other paths.

    The ratio is 0 without a straight path, and infinite without other paths.

    Args:
        paths: Paths from ``trace_paths``.
        tx: Antenna mount of the transmitters.
        rx: Antenna mount of the receivers.
    """
    power = path_powers(paths, tx, rx)
    straight = ((paths.kinds == 0) | (paths.kinds == KINDS.index("transmission"))).all(1)
    direct = _sum_links(paths, torch.where(straight, power, 0.0))
    others = _sum_links(paths, torch.where(straight, 0.0, power))
    ratio = direct / _nonzero(others)
    return torch.where(others > 0, ratio, torch.where(direct > 0, torch.inf, 0.0))


def path_powers(paths: RayPaths, tx: AntennaMount, rx: AntennaMount) -> Float64[Tensor, " path"]:
    """Ratio of received to transmitted power of each path, averaged over all pairs of elements.

    Args:
        paths: Paths from ``trace_paths``.
        tx: Antenna mount of the transmitters.
        rx: Antenna mount of the receivers.
    """
    amplitude, _ = path_amplitudes(paths, tx, rx)
    return torch.view_as_real(amplitude).square().sum(-1).mean((1, 2))


def _sum_links(paths: RayPaths, values: Tensor) -> Tensor:
    return sum_over_paths(paths, values).T


def _nonzero(total: Tensor) -> Tensor:
    return torch.where(total > 0, total, 1.0)
