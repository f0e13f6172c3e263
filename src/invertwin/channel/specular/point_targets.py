"""Echoes of point targets with multipath: all pairs of outbound and inbound specular paths.

A target above a smooth floor appears three times in radar data: directly, by the two mixed paths
with one reflection, and by the floor on both legs. Each leg is a specular path between an antenna
and the target (``specular.trace_paths``).
"""

import math

import torch
from jaxtyping import Complex128
from torch import Tensor

from invertwin.channel.em.antenna_fields import antenna_fields, coherent_paths
from invertwin.channel.em.plane_waves import polarisations
from invertwin.channel.paths import Link, Paths
from invertwin.channel.specular.ray_paths import RayPaths, match_rows
from invertwin.channel.specular.trace_paths import trace_paths
from invertwin.checks import ArrayLike, checked_tensor
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.scene.material.fresnel import safe_root
from invertwin.scene.scene import Scene


def trace_point_targets(
    scene: Scene,
    link: Link,
    targets: ArrayLike,
    cross_sections: ArrayLike,
    *,
    depth: int = 1,
    rays: int | None = 100_000,
    seed: int = 0,
) -> Paths:
    """Trace the echoes of point targets, with reflections and transmissions on both legs.

    ``a = a₁ · √(4πσ)/λ · a₂`` with the coefficients of both legs: in free space this is the radar
    equation ``σ λ² G²/((4π)³ R⁴)``. A target scatters isotropically and preserves the polarisation,
    as a sphere in backscatter, and occludes nothing. The phase of the echo is that of its delay.
    Delays of array elements are exact: reflected targets appear at their images. Add the paths to
    those of ``trace_field`` to simulate both with ``beat_signal``.

    Derivatives are those of ``trace_paths``: with respect to the scene, the targets and the
    antennas.

    Args:
        scene: scene that reflects, transmits and occludes.
        link: antennas, per frame, such as ``radar.link()``.
        targets: target positions, [target, 3], in world axes [m].
        cross_sections: radar cross-sections σ, [target] [m²].
        depth: maximum number of reflections on one leg.
        rays: number of rays of the search; None tests every sequence.
        seed: random seed of the rays.

    Raises:
        InputError: wrong shapes, negative cross-sections, and errors of ``trace_paths``.

    Source: the radar equation; derivations §10 for the legs.
    """
    positions = checked_tensor(targets, (None, 3), "targets [m]", "give a row of x, y, z for each")
    sizes = checked_tensor(
        cross_sections, (len(positions),), "cross-sections [m²]", "give one for each target"
    )
    if not len(positions) or bool((sizes < 0).any()):
        raise InputError(
            f"expected targets with cross-sections >= 0 m², got {sizes.tolist()}; give some"
        )
    frequency = SPEED_OF_LIGHT / link.wavelength

    def legs(antennas: Tensor) -> RayPaths:
        return trace_paths(scene, antennas, positions, frequency, depth=depth, rays=rays, seed=seed)

    outbound = legs(link.tx)
    inbound = outbound if torch.equal(link.tx, link.rx) else legs(link.rx)
    strength = (4 * math.pi * sizes).sqrt() / link.wavelength
    first, last = match_rows(outbound.link, inbound.link, link.frame_count * len(positions))
    out, back = outbound.select(first), inbound.select(last)
    outgoing = fields_at_target(link, out, transmits=True)
    returning = fields_at_target(link, back, transmits=False)
    # The target preserves the field vector in world axes.
    fields = returning @ outgoing.mT * strength[out.rx][:, None, None]
    return join_legs(link, out, back, fields)


def join_legs(
    link: Link, outbound: RayPaths, inbound: RayPaths, fields: Complex128[Tensor, "row r t"]
) -> Paths:
    """Coherent paths over pairs of legs to the same points, which array elements see at the images.

    Args:
        link: antennas; those of a frame have its number.
        outbound, inbound: legs to the point from the transmitter, and from the receiver.
        fields: coefficients between the Jones vectors of both arrays.
    """
    first = link.tx[outbound.tx] + outbound.length[:, None] * outbound.departure
    last = link.rx[inbound.tx] + inbound.length[:, None] * inbound.departure
    delay = outbound.delay + inbound.delay
    return coherent_paths(link, outbound.tx, delay, fields, first, last)


def fields_at_target(
    link: Link, legs: RayPaths, *, transmits: bool
) -> Complex128[Tensor, "row k 3"]:
    """Fields that an antenna's vectors radiate to the ends of legs, in world axes.

    By reciprocity, also those that it receives from there.

    Args:
        link: antennas; those of a frame have its number.
        legs: from the antenna to its target.
        transmits: True for the transmitter, False for the receiver.
    """
    amplitudes = antenna_amplitudes(link, legs, transmits=transmits)
    axes = polarisations(legs.arrival).to(amplitudes.dtype)
    return torch.einsum("nij,nkj,nix->nkx", legs.coefficient, amplitudes, axes)


def antenna_amplitudes(
    link: Link, legs: RayPaths, *, transmits: bool
) -> Complex128[Tensor, "row k 2"]:
    """Field amplitudes of an antenna's vectors along legs, in V and H of ``RayPaths``.

    Args:
        link, legs, transmits: as of ``fields_at_target``.
    """
    pattern = link.tx_pattern if transmits else link.rx_pattern
    jones = link.tx_jones if transmits else link.rx_jones
    rotation = link.rotations[legs.tx]
    gain = pattern.gain(torch.einsum("nij,ni->nj", rotation, legs.departure))
    strength = safe_root(gain, 0.0)
    fields = antenna_fields(jones, rotation, legs.departure)
    axes = polarisations(legs.departure).to(fields.dtype)
    return strength[:, None, None] * torch.einsum("nkx,nix->nki", fields, axes)
