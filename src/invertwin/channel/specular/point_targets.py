"""Echoes of small targets in a scene of mirrors and sheets: every way there, every way back.

A target that a smooth floor mirrors shows three times in radar data: directly, by the two mixed
ways with one reflection, and by way of the floor there and back. Each leg is a specular path
between an antenna and the target (``specular.trace_paths``).
"""

import math

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from invertwin.channel.em.antenna_fields import antenna_fields, combine_elements
from invertwin.channel.em.plane_waves import polarisations
from invertwin.channel.paths import Link, Paths, concatenate_paths
from invertwin.channel.specular.ray_paths import RayPaths
from invertwin.channel.specular.trace_paths import trace_paths
from invertwin.checks import ArrayLike, checked_tensor
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.scene.scene import Scene

_UP = (0.0, 0.0, 1.0)  # of V in ``RayPaths``


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
    """Field paths of point targets, also by way of what mirrors or lets through.

    ``a = a₁ · √(4πσ)/λ · a₂`` with the coefficients of both legs: between antennas that see the
    target alone this is the radar equation ``σ λ² G²/((4π)³ R⁴)``. A target sends back what meets
    it with the polarisation as it is, in all directions alike, as a sphere does straight back, and
    hides nothing. The phase of the echo is that of its delay. Delays of array elements are exact:
    mirrored targets are seen at their images. Add the paths to those of ``trace_field``, and
    ``beat_signal`` makes signals of both.

    Derivatives are those of ``trace_paths``: by the scene, the targets and the antennas.

    Args:
        scene: What mirrors, lets through and hides.
        link: Antennas, per frame, such as ``radar.link()``.
        targets: [target, 3] in the world [m].
        cross_sections: σ of each [m²].
        depth: Most surfaces that one leg meets.
        rays: Shot to find them; None tries every sequence.
        seed: Of the rays.

    Raises:
        InputError: Wrong shapes, negative cross-sections, and what ``trace_paths`` refuses.

    Source: the radar equation; derivations §10 for the legs.
    """
    places = checked_tensor(targets, (None, 3), "targets [m]", "give a row of x, y, z for each")
    sizes = checked_tensor(
        cross_sections, (len(places),), "cross-sections [m²]", "give one for each target"
    )
    if not len(places) or bool((sizes < 0).any()):
        raise InputError(
            f"expected targets with cross-sections >= 0 m², got {sizes.tolist()}; give some"
        )
    frequency = SPEED_OF_LIGHT / link.wavelength

    def legs(antennas: Tensor) -> RayPaths:
        return trace_paths(scene, antennas, places, frequency, depth=depth, rays=rays, seed=seed)

    forth = legs(link.tx)
    back = forth if torch.equal(link.tx, link.rx) else legs(link.rx)
    strength = (4 * math.pi * sizes).sqrt() / link.wavelength
    parts = []
    for frame in range(link.frame_count):
        own = forth.select(forth.tx == frame), back.select(back.tx == frame)
        out, home = _match_legs(own[0].rx, own[1].rx)
        parts.append(_echo_paths(link, frame, own[0].select(out), own[1].select(home), strength))
    return concatenate_paths(parts)


def _match_legs(outbound: Tensor, inbound: Tensor) -> tuple[Tensor, Tensor]:
    """Numbers of all pairs of legs that meet one target."""
    first, second = torch.nonzero(outbound[:, None] == inbound).unbind(1)
    return first, second


def _echo_paths(
    link: Link, frame: int, outbound: RayPaths, inbound: RayPaths, strength: Tensor
) -> Paths:
    """One echo for each pair of legs, both from their antenna to the target."""
    # A leg back is the leg there the other way: its matrix is transposed.
    sent = _antenna_amplitudes(link, frame, outbound, transmits=True)
    received = _antenna_amplitudes(link, frame, inbound, transmits=False)
    there = torch.einsum("nij,ntj->nti", outbound.coefficient, sent)
    back = torch.einsum("nij,nrj->nri", inbound.coefficient, received)
    # What arrives at the target as a vector in the world leaves it as that vector.
    arrives, leaves = _polarisation_axes(outbound.arrival), _polarisation_axes(inbound.arrival)
    turn = torch.einsum("nix,njx->nij", leaves, arrives).to(there.dtype)
    matrix = torch.einsum("nri,nij,ntj->nrt", back, turn, there)
    matrix = matrix * strength[outbound.rx][:, None, None]
    coefficient, whole = combine_elements(link, matrix)
    delay = outbound.delay + inbound.delay
    return Paths(
        frame=torch.full((len(outbound),), frame),
        delay=delay,
        coefficient=coefficient,
        power=torch.zeros_like(delay),
        # Where the elements of an array see the target: at its image.
        first=link.tx[frame] + outbound.length[:, None] * outbound.departure,
        last=link.rx[frame] + inbound.length[:, None] * inbound.departure,
        kind="coherent",
        boundary=torch.zeros(len(outbound), dtype=torch.bool),
        matrix=whole,
    )


def _antenna_amplitudes(
    link: Link, frame: int, legs: RayPaths, *, transmits: bool
) -> Complex128[Tensor, "row k 2"]:
    """Fields of an antenna's vectors along legs, over V and H of ``RayPaths``."""
    pattern = link.tx_pattern if transmits else link.rx_pattern
    jones = link.tx_jones if transmits else link.rx_jones
    rotation = link.rotations[frame].expand(len(legs), 3, 3)
    gain = pattern.gain(torch.einsum("nij,ni->nj", rotation, legs.departure))
    lit = gain > 0  # a root of zero has no derivative
    strength = torch.where(lit, torch.where(lit, gain, 1.0).sqrt(), 0.0)
    fields = antenna_fields(jones, rotation, legs.departure)
    axes = _polarisation_axes(legs.departure).to(fields.dtype)
    return strength[:, None, None] * torch.einsum("nkx,nix->nki", fields, axes)


def _polarisation_axes(direction: Float64[Tensor, "row 3"]) -> Float64[Tensor, "row 2 3"]:
    return polarisations(direction, torch.tensor(_UP, dtype=torch.float64))
