"""Beamforming: range profiles of the virtual channels to power over range × direction."""

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from invertwin.channel import Grid
from invertwin.checks import check_shape
from invertwin.radar.aperture import Aperture, aperture
from invertwin.radar.radar import Radar
from invertwin.radar.signal.range_profile import range_profile


def beamform(
    profile: Complex[Tensor, "frame tx rx range"], radar: Radar, grid: Grid
) -> Float[Tensor, "frame range u v"]:
    """Compute the Bartlett power spectrum at the grid's directions.

    Steering is exp(+jk(u y + v z)) on the beat signal, whose phase falls as the element moves
    towards the target. Normalised by the sum of the weights: a point target of |a|² peaks at
    |a|². Along an axis that the grid does not resolve, the power of the elements is averaged.

    Args:
        profile: range profiles from ``range_profile``.
        radar: radar that recorded it.
        grid: bins of range and direction.

    Raises:
        InputError: The profile does not fit radar and grid, the array is not planar, or the grid
            resolves only one axis of an array that is not the product of a row and a column.
    """
    what = "a profile (frame, tx, rx, range)"
    expected = (*radar.shape, grid.range_count)
    check_shape(profile, expected, what, "use the radar and grid of range_profile")
    channels = profile.flatten(1, 2)
    if grid.u_count == grid.v_count == 1:
        return channels.abs().square().mean(1)[..., None, None]
    array = aperture(radar)
    array.check_resolved(grid)
    if array.is_separable:
        return _separable_power(channels, array, grid)
    both = array.beams(grid.u, grid.v, array.y[array.column], array.z[array.row]) * array.weight
    power = (both.to(channels) @ channels).abs().square().unflatten(1, (grid.u_count, grid.v_count))
    return power.movedim(-1, 1)


def exact_spectrum(
    beat: Complex[Tensor, "frame tx rx sample"], radar: Radar, grid: Grid
) -> Float[Tensor, "frame range u v"]:
    """Compute the power spectrum as a radar does: ``range_profile``, then ``beamform``.

    Args:
        beat: Beat signals.
        radar: radar that recorded them.
        grid: Bins of range and direction.
    """
    return beamform(range_profile(beat, radar, grid), radar, grid)


def _separable_power(channels: Tensor, array: Aperture, grid: Grid) -> Tensor:
    plane = array.plane(channels.movedim(1, -1))

    def steer(cosines: Tensor, places: Tensor, weight: Tensor) -> Tensor:
        return (array.steering(cosines, places) * (weight / weight.sum())).to(channels)

    if grid.v_count > 1:
        v = steer(grid.v, array.z, array.z_taper * array.counts.sum(0))
        plane = torch.einsum("vz,fryz->fryv", v, plane)
    if grid.u_count > 1:
        u = steer(grid.u, array.y, array.y_taper * array.counts.sum(1))
        plane = torch.einsum("uy,fryv->fruv", u, plane)
    power = plane.abs().square()
    single = [dim for dim, count in ((2, grid.u_count), (3, grid.v_count)) if count == 1]
    return power.mean(single, keepdim=True) if single else power
