"""Power scattered by clouds of soft scatterers, deposited into the bins of a map.

Geometry and transmittance are torch in float64, so that automatic differentiation in both modes
yields their derivatives; only the deposit is a kernel. A cloud has no silhouette: its power is
continuous in all parameters, so it needs no boundary terms.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float32, Float64, Int64
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import grid_sample

from invertwin.channel.em.depolarisation import polarisation_shares
from invertwin.channel.paths import Grid, Link
from invertwin.channel.power import bins
from invertwin.channel.power.bins import Splat
from invertwin.channel.rays.backend import use_backend
from invertwin.channel.sampling import Sampling
from invertwin.errors import InputError
from invertwin.scene.cloud import Cloud
from invertwin.scene.scene import Object

_POINTS_PER_CHUNK = 262_144  # most points at a time
_MIN_COMPONENT = 1e-12  # least component of a direction, for rays along a face of the box


def deposit_density(
    item: Object, link: Link, grid: Grid, *, sampling: Sampling, seed: int
) -> Float32[Tensor, "frame range u v"]:
    """Compute the expected received over transmitted power of a cloud in every bin, per frame.

        ∫ (λ/4π)² G_t G_r / (R_t R_r)² · (albedo/4π) σ exp(−∫_t σ ds − ∫_r σ ds) dV

    with the segments t and r through the cloud from the antennas to the point; one segment serves
    both if the link shares its visibility. Rays start at the transmitter, through points spread
    evenly over the box. Along a ray every segment scatters 1 − exp(−σΔ) of the power that reaches
    it, so that opaque cells lose nothing.
    Differentiable in both modes with respect to densities, albedo, the object's pose and the
    radar's poses and patterns. Meshes neither occlude the cloud nor are occluded by it.

    Source: the radiative transfer of single scattering; units of ``deposit_power``.
    Differs from the source: the paper has no densities.

    Args:
        item: object with a cloud.
        link: antennas, per frame.
        grid: bins of one frame.
        sampling: number of points on rays over all frames, and backend.
        seed: seed; the same seed yields the same result to 1e-6 (atomic additions reorder).

    Raises:
        InputError: An object without a cloud or in motion, or an antenna inside the box.
    """
    if item.cloud is None:
        raise InputError(
            "expected an object with a cloud, got one without; use deposit_power for meshes"
        )
    if item.velocity is not None and bool(item.velocity.any()):
        raise InputError(
            "expected a cloud at rest, got a velocity; a frame is one instant: use scene.at(time)"
        )
    layout = bins.BinLayout.from_link(grid, link)
    with use_backend(sampling.backend):
        rays = _CloudRays.sample(item, link, sampling.samples, seed)
        parts = [Splat.apply(layout, *part) for part in rays.contributions()]
    return torch.stack(parts).sum(0)


@dataclass(frozen=True)
class _CloudRays:
    """Rays through the box of a cloud, one row each, in the object's frame.

    Attributes:
        cloud: density.
        link: antennas.
        origins: positions of the transmitter and the receiver in every frame [m].
        rotation: rotation of the object.
        frame: frame of every ray.
        box_points: point of the box through which each ray passes [m].
        jitter: position of the points within their segments, in [0, 1).
        steps: segments of a ray.
    """

    cloud: Cloud
    link: Link
    origins: tuple[Float64[Tensor, "frame 3"], Float64[Tensor, "frame 3"]]
    rotation: Float64[Tensor, "3 3"]
    frame: Int64[Tensor, " ray"]
    box_points: Float64[Tensor, "ray 3"]
    jitter: Float64[Tensor, " ray"]
    steps: int

    @staticmethod
    def sample(item: Object, link: Link, samples: int, seed: int) -> "_CloudRays":
        cloud = item.cloud
        assert cloud is not None
        pose = item.transform
        rotation = pose[:3, :3]
        origins = tuple((antennas - pose[:3, 3]) @ rotation for antennas in (link.tx, link.rx))
        for antennas in origins:
            inside = ((antennas > cloud.low) & (antennas < cloud.high)).all(1)
            if bool(inside.any()):
                raise InputError(
                    "expected the antennas outside of the cloud's box, got one inside of it in "
                    f"frame {int(inside.int().argmax())}; choose a smaller box"
                )
        # About one point per cell on the longest ray through the box.
        steps = math.ceil(math.hypot(*(count - 1 for count in cloud.density.shape)))
        count = max(1, round(samples / (link.frame_count * steps)))
        # Consecutive rows of a Sobol sequence are well spread: every frame gets its own.
        engine = torch.quasirandom.SobolEngine(4, scramble=True, seed=seed)
        numbers = engine.draw(link.frame_count * count, dtype=torch.float64)
        return _CloudRays(
            cloud=cloud,
            link=link,
            origins=(origins[0], origins[1]),
            rotation=rotation,
            frame=torch.arange(link.frame_count).repeat_interleave(count),
            box_points=cloud.low + numbers[:, :3].roll(1, 1) * (cloud.high - cloud.low),
            jitter=numbers[:, 3],
            steps=steps,
        )

    def contributions(self) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor, Tensor]]:
        """Iterate over frame, power, range, u and v of the points, chunk by chunk."""
        per_frame = len(self.frame) // self.link.frame_count
        segments = 1 if self.link.shared_visibility else self.steps
        width = max(1, _POINTS_PER_CHUNK // (self.steps * segments))
        for start in range(0, len(self.frame), width):
            part = slice(start, start + width)
            columns = {n: getattr(self, n)[part] for n in ("frame", "box_points", "jitter")}
            yield replace(self, **columns)._evaluate_points(per_frame)

    def _evaluate_points(self, per_frame: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        tx = self.origins[0][self.frame]
        offset = self.box_points - tx
        direction = offset / offset.norm(dim=1, keepdim=True)
        near, far = self._clip_to_box(tx, direction)
        # Rays per steradian, of points spread evenly over the box: the chord's share of it.
        weight = 3 * (self.cloud.high - self.cloud.low).prod() / ((far**3 - near**3) * per_frame)
        length = (far - near)[:, None] / self.steps
        fraction = torch.arange(self.steps) + self.jitter[:, None]
        distance = near[:, None] + fraction * length  # from the transmitter
        points = tx[:, None] + distance[..., None] * direction[:, None]
        thickness = self._interpolate_density(points) * length
        before = thickness.cumsum(1) - thickness
        link, frame = self.link, self.frame[:, None].expand_as(distance)
        if link.shared_visibility:
            depths = 2 * before
        else:
            # From the start of the segment, at the density of the segment: otherwise an opaque cell
            # would attenuate as if all its power were scattered at the point.
            depths = before + self._return_optical_depth(points, frame)
            depths = depths - self.jitter[:, None] * thickness
        scattered = -0.5 * torch.exp(-depths) * torch.expm1(-2 * thickness)
        back = points - self.origins[1][self.frame][:, None]
        return_length = back.norm(dim=2)
        rotation = link.rotations[self.frame]
        directions = direction[:, None], back / return_length[..., None]
        to_radar = rotation.mT @ self.rotation
        local = [torch.einsum("rij,rkj->rki", to_radar, way) for way in directions]
        gain = link.tx_pattern.gain(local[0]) * link.rx_pattern.gain(local[1])
        scale = (link.wavelength / (4 * math.pi)) ** 2 * self.cloud.albedo / (4 * math.pi)
        (share,) = polarisation_shares(link, depolarising=False)
        scale = scale * share.for_bounces(1)
        power = scale * weight[:, None] * gain * scattered / return_length.square()
        columns = [power, 0.5 * (distance + return_length), local[1][..., 1], local[1][..., 2]]
        return frame.reshape(-1), *(column.reshape(-1) for column in columns)  # type: ignore[return-value]

    def _clip_to_box(self, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the distances at which rays that meet the box enter and leave it."""
        ray = torch.where(direction.abs() < _MIN_COMPONENT, _MIN_COMPONENT, direction)
        first, second = (self.cloud.low - origin) / ray, (self.cloud.high - origin) / ray
        near = torch.minimum(first, second).amax(1).clamp_min(0.0)
        return near, torch.maximum(first, second).amin(1)

    def _return_optical_depth(self, points: Tensor, frame: Tensor) -> Tensor:
        """Integrate ∫σ ds from points to the receiver."""
        flat = points.reshape(-1, 3)
        rx = self.origins[1][frame.reshape(-1)]
        offset = flat - rx
        distance = offset.norm(dim=1)
        direction = offset / distance[:, None]
        near, _ = self._clip_to_box(rx, direction)
        length = (distance - near)[:, None] / self.steps
        shift = self.jitter[:, None].expand(points.shape[:2]).reshape(-1, 1)
        depth = near[:, None] + (torch.arange(self.steps) + shift) * length
        between = rx[:, None] + depth[..., None] * direction[:, None]
        return (self._interpolate_density(between) * length).sum(1).reshape(points.shape[:2])

    def _interpolate_density(self, points: Tensor) -> Tensor:
        position = 2 * (points - self.cloud.low) / (self.cloud.high - self.cloud.low) - 1
        found = _Trilinear.apply(self.cloud.density, position.reshape(-1, 3))
        return found.reshape(points.shape[:2])


def _interpolate_trilinear(values: Tensor, positions: Tensor) -> Tensor:
    """Interpolate between the nodes of a grid that spans [-1, 1] along each axis."""
    nodes = positions.flip(-1)[None, :, None, None]  # grid_sample counts axes from the last one
    found = grid_sample(values[None, None], nodes, padding_mode="border", align_corners=True)
    return found.flatten()


class _Trilinear(torch.autograd.Function):
    """``_interpolate_trilinear`` with the forward-mode derivative that torch 2.13 lacks."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, positions: Tensor) -> Tensor:
        ctx.inputs = values.detach(), positions.detach()
        return _interpolate_trilinear(*ctx.inputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        pairs = zip(ctx.inputs, ctx.needs_input_grad, strict=True)
        inputs = [tensor.detach().requires_grad_(wanted) for tensor, wanted in pairs]
        wanted = [tensor for tensor in inputs if tensor.requires_grad]
        with torch.enable_grad():
            found = iter(torch.autograd.grad(_interpolate_trilinear(*inputs), wanted, grad))
        return tuple(next(found) if tensor.requires_grad else None for tensor in inputs)

    @staticmethod
    def jvp(ctx: Any, values: Tensor | None, positions: Tensor | None) -> Tensor:  # type: ignore[override]
        known, at = ctx.inputs
        total = torch.zeros_like(at[:, 0])
        if values is not None:
            total = total + _interpolate_trilinear(values, at)
        if positions is not None:
            with torch.enable_grad():
                at = at.detach().requires_grad_()
                (slope,) = torch.autograd.grad(_interpolate_trilinear(known, at).sum(), at)
            total = total + (slope * positions).sum(1)
        return total
