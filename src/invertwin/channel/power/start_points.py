"""Start points of paths: rays from the transmitter into caps around objects, or points by area.

Detached: a sample is a material point (triangle and barycentric coordinates), a frame, and one
over its density. Values that depend on the scene's parameters are evaluated later, in material
form (derivations §2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from invertwin.channel.paths import Link
from invertwin.channel.power import integrand
from invertwin.channel.power import transmission as sheets
from invertwin.channel.power.integrand import Inputs
from invertwin.channel.rays import arrays
from invertwin.channel.rays.backend import dr, mi, mit
from invertwin.channel.rays.bounding_spheres import BoundingSpheres
from invertwin.channel.rays.ray_scene import RayScene, face_areas
from invertwin.channel.rays.scene_tables import Geometry
from invertwin.channel.rays.surface_point import SurfacePoint, interpolate_position
from invertwin.errors import InputError

Reference = tuple[Geometry, Link]  # define the sampling densities instead of the scene


@dataclass(frozen=True)
class StartPoints:
    """Samples of surface points.

    Attributes:
        frame: radar poses.
        point: surface points.
        weight: one over (samples × probability per area).
        transmission: transmission of the segments from the transmitter.
    """

    frame: mit.UInt32
    point: SurfacePoint
    weight: mit.Float
    transmission: sheets.SegmentTransmission


class RaySampler:
    """Rays from the transmitter, as many into the cap around each object, jittered on a grid.

    Args:
        rays: ray scene.
        samples: approximate number of rays over all frames and scenes.
        seed: seed of the rays.
        reference: geometry and antennas that define the caps instead of the scene, a tenth larger.
    """

    def __init__(
        self, rays: RayScene, samples: int, seed: int, reference: Reference | None = None
    ) -> None:
        self.rays, self.spheres, self.origins = rays, rays.spheres, rays.tx
        if reference:
            self.spheres = BoundingSpheres(reference[0], rays.origin, margin=1.1)
            self.origins = arrays.to_points(reference[1].tx.detach() - rays.origin)
        blocks = rays.poses_per_scene * self.spheres.object_count
        self.rows = max(1, int(np.sqrt(samples / blocks)))
        self.columns = max(1, samples // blocks // self.rows)
        self.size = blocks * self.rows * self.columns
        self.seed, self.transmission_seed = (arrays.scramble_seed(seed, k) for k in (0, 8))

    def draw(self, index: mit.UInt32, inputs: Inputs) -> StartPoints:
        """Draw the samples of given numbers.

        Args:
            index: sample numbers below ``size``.
            inputs: detached inputs.
        """
        rays, per_block = self.rays, self.rows * self.columns
        block, cell = index // per_block, index % per_block
        own, scene = self.spheres.table_entry(block % self.spheres.object_count)
        frame = scene * rays.poses_per_scene + block // self.spheres.object_count
        centre = arrays.gather_points(self.origins, frame)
        axis, height, _ = self.spheres.cap(own, centre)
        jitter = arrays.uniform_pair(index, self.seed)
        column, row = cell % self.columns, cell // self.columns
        x = (mi.Float(column) + jitter[0]) / self.columns
        y = (mi.Float(row) + jitter[1]) / self.rows
        disk = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(x, y))
        depth = dr.squared_norm(disk) * height
        spread = dr.sqrt(height * (2 - depth))
        local = mi.Vector3f(disk.x * spread, disk.y * spread, 1 - depth)
        direction = dr.normalize(arrays.tangent_frame(axis).to_world(local))
        group = own // self.spheres.group_size
        every = mi.Bool(True)
        found, around = self.spheres.group_density(rays, group, centre, direction, every, own)
        density = per_block * (found + around / (4 * dr.pi))
        centre = arrays.gather_points(rays.tx, frame)
        ray, key = mi.Ray3f(centre, direction), (index, self.transmission_seed)
        bits = _stratified_bits(column, row)
        hit = sheets.trace_to_surface(inputs, ray, every, key, coherent=True, stratified_bits=bits)
        point = integrand.compute_interaction(inputs, hit.point)
        cosine = dr.maximum(dr.abs(dr.dot(point.normal, direction)), 1e-6)
        distance = dr.squared_norm(point.position - centre)
        counts = hit.valid & (self.spheres.face_group(hit.point.face) == group)
        weight = dr.select(counts, distance / (cosine * density * hit.probability), 0.0)
        return StartPoints(frame, hit.point, weight, hit.transmission)


def _stratified_bits(column: mit.UInt32, row: mit.UInt32) -> mit.UInt32:
    """Compute bits that split a grid into halves as even as itself, repeatedly."""
    bits = mi.UInt32(0)
    for k in range(sheets.STRATIFIED_SHEETS // 2):
        x, y = column >> k, row >> k
        bits |= (((x ^ y) & 1) | ((y & 1) << 1)) << (2 * k)
    return bits


class AreaSampler:
    """Points on all surfaces, with the probabilities per triangle of a reference scene.

    A fixed reference keeps the points under finite differences (common random numbers) even if
    areas change.

    Args:
        rays: ray scene.
        samples: approximate number of points over all frames.
        seed: seed of the points.
        reference: geometry (and antennas) whose areas count; None = the scene.
    """

    def __init__(
        self, rays: RayScene, samples: int, seed: int, reference: Reference | None = None
    ) -> None:
        geometry = reference[0] if reference else rays.geometry
        if len(geometry.faces) != len(rays.geometry.faces):
            raise InputError(
                f"expected a reference scene of {len(rays.geometry.faces)} triangles, got "
                f"{len(geometry.faces)}; use the scene the differences start from"
            )
        areas = face_areas(geometry)
        self.rays = rays
        self.per_frame = max(1, samples // rays.link.frame_count)
        self.size = self.per_frame * rays.link.frame_count
        self.distribution = mi.DiscreteDistribution(arrays.to_float(areas / areas.mean()))
        self.seeds = arrays.scramble_seed(seed, 1), arrays.scramble_seed(seed, 2)

    def draw(self, index: mit.UInt32, inputs: Inputs) -> StartPoints:
        """Draw the samples of given numbers.

        Args:
            index: sample numbers below ``size``.
            inputs: detached inputs.
        """
        rays = self.rays
        frame, number = index // self.per_frame, index % self.per_frame
        jitter, _ = arrays.uniform_pair(index, self.seeds[0])
        face, pmf = self.distribution.sample_pmf((mi.Float(number) + jitter) / self.per_frame)
        b = mi.warp.square_to_uniform_triangle(
            mi.Point2f(*arrays.uniform_pair(index, self.seeds[1]))
        )
        triangle = p0, p1, p2 = rays.corners(face)
        area = 0.5 * dr.norm(dr.cross(p1 - p0, p2 - p0))
        position = interpolate_position(triangle, b.x, b.y)
        tx = arrays.gather_points(rays.tx, frame)
        passed = sheets.trace_transmission(inputs, tx, position, mi.Bool(True))
        weight = dr.select(passed.transmittance > 0, area / (pmf * self.per_frame), 0.0)
        return StartPoints(frame, SurfacePoint(face, b.x, b.y), weight, passed)
