"""Integrand of the path integral at one vertex of a path, in Dr.Jit.

Values carry derivatives if the ``Inputs`` do. The torch form of these formulas, in float64, is
``channel/coherent/radar_equation.py``; tests hold the two equal.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from invertwin.channel.paths import GainPattern
from invertwin.channel.power.surface import SCATTERING_TABLES, ScatteringLawTables
from invertwin.channel.rays import arrays, surface_point
from invertwin.channel.rays.backend import Mask, dr, mi, mit
from invertwin.channel.rays.ray_scene import RayScene
from invertwin.channel.rays.surface_point import SurfacePoint, Triangle, interpolate_position

#: Differentiable inputs of the kernels, in the order of the arguments of the torch function.
DIFFERENTIABLE = ("vertices", "tx", "rx", "rotations", *SCATTERING_TABLES)
POINT_TABLES = DIFFERENTIABLE[:3]


def to_table(name: str, values: Tensor) -> mit.Float:
    """Convert a torch table to the layout of the kernels.

    Args:
        name: name of the table, one of ``DIFFERENTIABLE``.
        values: torch table.
    """
    return arrays.to_points(values) if name in POINT_TABLES else arrays.to_float(values)


def from_table(name: str, values: mit.Float, like: Tensor) -> Tensor:
    """Convert a table of the kernels, or a derivative with respect to one, to torch.

    Args:
        name: name of the table, one of ``DIFFERENTIABLE``.
        values: array in the layout of the table.
        like: torch table of the shape and type that are returned.
    """
    flat = arrays.from_points(values) if name in POINT_TABLES else arrays.to_torch(values)
    return flat.reshape(like.shape).to(like)


@dataclass(frozen=True)
class Inputs:
    """Ray scene and its flat Dr.Jit arrays; ``DIFFERENTIABLE`` names those with derivatives.

    Attributes:
        vertices: vertex positions about the local origin [m], see ``to_points``.
        tx, rx: positions of the transmitter and the receiver in every frame, likewise.
        rotations: rotation of the radar in every frame.
        surfaces: tables of the scattering laws.
        face_surface: row of every triangle in the tables of surfaces.
        triangles: ``RayScene.triangles``, used if the vertices carry no derivatives.
        monostatic: True if both antennas are one.
        tx_pattern, rx_pattern: antenna patterns.
        scale: (λ/4π)² [m²].
        rays: ray scene.
        coupling: polarisation factors of paths with an odd and an even number of bounces.
    """

    vertices: mit.Float
    tx: mit.Float
    rx: mit.Float
    rotations: mit.Float
    surfaces: ScatteringLawTables
    face_surface: mit.UInt32
    triangles: mit.Float
    monostatic: bool
    tx_pattern: PatternTable
    rx_pattern: PatternTable
    scale: float
    rays: RayScene
    coupling: tuple[float, float] = (1.0, 1.0)

    @staticmethod
    def from_rays(rays: RayScene, *, monostatic: bool = False) -> Inputs:
        """Upload a scene and its antennas; positions are about the local origin.

        Args:
            rays: ray scene.
            monostatic: True to use one segment for both antennas if they are one; derivatives
                with respect to ``rx`` then count as derivatives with respect to ``tx``.
        """
        link = rays.link
        return Inputs(
            vertices=rays.vertices,
            tx=rays.tx,
            rx=rays.rx,
            rotations=arrays.to_float(link.rotations),
            surfaces=ScatteringLawTables.from_geometry(rays.geometry),
            face_surface=arrays.to_index(rays.geometry.face_surface),
            triangles=rays.triangles,
            monostatic=monostatic,
            tx_pattern=PatternTable.from_pattern(link.tx_pattern),
            rx_pattern=PatternTable.from_pattern(link.rx_pattern),
            scale=(link.wavelength / (4 * np.pi)) ** 2,
            rays=rays,
        )

    def table(self, name: str) -> mit.Float:
        """Return one of the differentiable inputs."""
        return self.surfaces.tables[name] if name in SCATTERING_TABLES else getattr(self, name)

    def with_tables(self, tables: dict[str, mit.Float]) -> Inputs:
        """Replace some of the differentiable inputs."""
        rows = {name: table for name, table in tables.items() if name in SCATTERING_TABLES}
        others = {name: table for name, table in tables.items() if name not in SCATTERING_TABLES}
        surfaces = replace(self.surfaces, tables={**self.surfaces.tables, **rows})
        return replace(self, surfaces=surfaces, **others)

    def detach(self) -> Inputs:
        """Return these inputs without derivatives."""
        return self.with_tables({name: dr.detach(self.table(name)) for name in DIFFERENTIABLE})

    def polarisation_factor(self, bounces: mit.UInt32) -> mit.Float:
        """Compute the power factor of the antennas' polarisations from the number of bounces."""
        odd, even = self.coupling
        return mi.Float(odd) if odd == even else dr.select((bounces & 1) == 1, odd, even)

    def antenna_position(
        self, frame: mit.UInt32, receiver: Mask, active: Mask = True
    ) -> mit.Point3f:
        """Look up the position of the receiver or the transmitter, about the local origin [m].

        Args:
            frame: radar poses.
            receiver: True for the receiver (a bool, or one per lane).
            active: mask of active lanes.
        """
        if receiver is True or receiver is False:
            table = self.rx if receiver and not self.monostatic else self.tx
            return arrays.gather_points(table, frame, active)
        rx, tx = (self.antenna_position(frame, end, active) for end in (True, False))
        return dr.select(receiver, rx, tx)

    def gain(self, frame: mit.UInt32, receiver: Mask, direction: mit.Vector3f) -> mit.Float:
        """Evaluate the linear power gain of the receiver or the transmitter.

        Args:
            frame: radar poses.
            receiver: True for the receiver (a bool, or one per lane).
            direction: unit directions in the radar frame.
        """
        if receiver is True or receiver is False:
            return (self.rx_pattern if receiver else self.tx_pattern).gain(direction)
        return dr.select(receiver, self.rx_pattern.gain(direction), self.tx_pattern.gain(direction))


@dataclass(frozen=True)
class PatternTable:
    """Antenna pattern on a grid, bilinear in cosθ and φ.

    Attributes:
        values: linear power gains, row after row.
        shape: numbers of nodes in cosθ and φ.
        constant_gain: gain of a pattern of one node.
    """

    values: mit.Float
    shape: tuple[int, int]
    constant_gain: float | None

    @staticmethod
    def from_pattern(pattern: GainPattern) -> PatternTable:
        table = pattern.table()
        rows, columns = int(table.shape[0]), int(table.shape[1])
        constant = float(table.reshape(-1)[0]) if rows * columns == 1 else None
        return PatternTable(arrays.to_float(table), (rows, columns), constant)

    def gain(self, direction: mit.Vector3f) -> mit.Float:
        """Interpolate the linear power gain at unit directions in the radar frame."""
        if self.constant_gain is not None:
            return mi.Float(self.constant_gain)
        rows, columns = self.shape
        t = (dr.clip(direction.x, -1.0, 1.0) + 1) * (0.5 * (rows - 1))
        row = dr.minimum(mi.UInt32(dr.detach(t)), rows - 2)
        along = t - mi.Float(row)
        if columns == 1:
            low, high = (dr.gather(mi.Float, self.values, line) for line in (row, row + 1))
            return low + (high - low) * along
        s = (dr.atan2(direction.z, direction.y) / (2 * dr.pi) + 0.5) * columns
        column = dr.minimum(mi.UInt32(dr.detach(s)), columns - 1)
        across = s - mi.Float(column)
        nearby = (column + 1) % columns
        rows_of_gain = []
        for line in (row, row + 1):
            low = dr.gather(mi.Float, self.values, line * columns + column)
            high = dr.gather(mi.Float, self.values, line * columns + nearby)
            rows_of_gain.append(low + (high - low) * across)
        return rows_of_gain[0] + (rows_of_gain[1] - rows_of_gain[0]) * along


def corners(inputs: Inputs, face: mit.UInt32, active: Mask = True) -> Triangle:
    """Gather the corners of triangles, attached.

    Args:
        inputs: attached inputs.
        face: triangle indices.
        active: mask of active lanes.
    """
    return surface_point.corners(inputs.vertices, inputs.rays.topology.device_corners, face, active)


@dataclass
class SurfaceInteraction:
    """Location and orientation of a material point; all but its surface is attached.

    Not frozen, since loops of Dr.Jit assign their state field by field.

    Attributes:
        position: position about the local origin [m].
        normal: unit normal.
        surface_row: row in the tables of surfaces.
        jacobian: area of the triangle over its detached area: 1 in value; None in loops.
    """

    position: mit.Point3f
    normal: mit.Vector3f
    surface_row: mit.UInt32
    jacobian: mit.Float | None

    def detach(self) -> SurfaceInteraction:
        """Return the detached form that loops carry."""
        position, normal = mi.Point3f(dr.detach(self.position)), mi.Vector3f(dr.detach(self.normal))
        return SurfaceInteraction(position, normal, self.surface_row, None)


def compute_interaction(
    inputs: Inputs, point: SurfacePoint, active: Mask = True
) -> SurfaceInteraction:
    """Locate surface points.

    Args:
        inputs: inputs of the kernel.
        point: surface points.
        active: mask of active lanes.
    """
    face, b1, b2 = point.face, point.b1, point.b2
    surface = dr.gather(mi.UInt32, inputs.face_surface, face, active)
    if not dr.grad_enabled(inputs.vertices):
        p0, first, second = (
            dr.gather(mi.Vector4f, inputs.triangles, face * 3 + k, active) for k in range(3)
        )
        position = mi.Point3f(p0.xyz + b1 * first.xyz + b2 * second.xyz)
        normal = mi.Vector3f(p0.w, first.w, second.w)
        return SurfaceInteraction(position, normal, surface, mi.Float(1.0))
    triangle = p0, p1, p2 = corners(inputs, face, active)
    normal = dr.cross(p1 - p0, p2 - p0)
    double_area = dr.norm(normal)
    position = interpolate_position(triangle, b1, b2)
    jacobian = double_area / dr.detach(double_area)
    return SurfaceInteraction(position, normal / double_area, surface, jacobian)


def pull_interaction(
    inputs: Inputs,
    point: SurfacePoint,
    active: mit.Bool,
    position: mit.Point3f,
    normal: mit.Vector3f,
    jacobian: mit.Float,
) -> None:
    """Adjoint of ``compute_interaction``, written out: add to the gradient of the corners.

    Args:
        inputs: attached inputs.
        point: surface points.
        active: mask of active lanes.
        position, normal, jacobian: derivatives of the loss with respect to the fields of the
            interaction.
    """
    b1, b2 = point.b1, point.b2
    rows = point.face * 3 + 1, point.face * 3 + 2
    first, second = (dr.gather(mi.Vector4f, inputs.triangles, row, active).xyz for row in rows)
    crossed = dr.cross(first, second)
    scale = dr.rsqrt(dr.squared_norm(crossed))
    unit = crossed * scale
    # With respect to the cross product of the sides, then with respect to the sides.
    turn = (normal + unit * (jacobian - dr.dot(unit, normal))) * scale
    by_first, by_second = dr.cross(second, turn), dr.cross(turn, first)
    gradients = (
        position * (1 - b1 - b2) - by_first - by_second,  # type: ignore[operator]
        position * b1 + by_first,  # type: ignore[operator]
        position * b2 + by_second,  # type: ignore[operator]
    )
    # Only the derivatives of this sum count: its value is never computed.
    triangle = corners(inputs, point.face, active)
    dr.backward_from(sum(dr.dot(p, g) for p, g in zip(triangle, gradients, strict=True)))


def direction_and_distance(start: mit.Point3f, end: mit.Point3f) -> tuple[mit.Vector3f, mit.Float]:
    """Compute the unit direction and the distance [m] from one point to another.

    Args:
        start, end: ends of the segment.
    """
    offset = end - start
    distance = dr.norm(offset)
    return offset / distance, distance  # type: ignore[return-value]


def to_radar_frame(inputs: Inputs, frame: mit.UInt32, direction: mit.Vector3f) -> mit.Vector3f:
    """Rotate world directions into the radar frame.

    Args:
        inputs: inputs of the kernel.
        frame: radar poses.
        direction: unit directions in the world.
    """
    return project_to_axes(radar_axes(inputs, frame), direction)


def radar_axes(inputs: Inputs, frame: mit.UInt32, active: Mask = True) -> list[mit.Vector3f]:
    """Gather the rows of the radar's rotation, whose columns are the radar's axes.

    Args:
        inputs: inputs of the kernel.
        frame: radar poses.
        active: mask of active lanes.
    """
    return [dr.gather(mi.Vector3f, inputs.rotations, frame * 3 + k, active) for k in range(3)]


def project_to_axes(rows: list[mit.Vector3f], direction: mit.Vector3f) -> mit.Vector3f:
    """Rotate world directions into the radar frame.

    Args:
        rows: rows of the radar's rotation.
        direction: unit directions in the world.
    """
    return mi.Vector3f(*(sum(rows[k][axis] * direction[k] for k in range(3)) for axis in range(3)))


@dataclass(frozen=True)
class SegmentMedium:
    """Medium of a segment.

    Attributes:
        refractive_index: refractive index.
        attenuation: power attenuation [1/m].
    """

    refractive_index: mit.Float
    attenuation: mit.Float


def find_medium(
    inputs: Inputs,
    start: SurfaceInteraction,
    end: SurfaceInteraction | None,
    direction: mit.Vector3f,
    active: mit.Bool,
) -> SegmentMedium:
    """Find the medium of segments: that of the refracting body whose interface they meet inside.

    Args:
        inputs: inputs of the kernel.
        start: surface interaction at the start.
        end: surface interaction at the end; None for an antenna.
        direction: unit directions from start to end.
        active: mask of active lanes.
    """
    index, attenuation = mi.Float(1.0), mi.Float(0.0)
    ends = ((start, 1.0),) if end is None else ((start, 1.0), (end, -1.0))
    for point, sign in ends if inputs.surfaces.has_refracting_bodies else ():
        inside = active & (dr.detach(dr.dot(point.normal, direction)) * sign < 0)
        inside &= inputs.surfaces.is_refracting(point.surface_row)
        values = (
            inputs.surfaces.value(n, point.surface_row, inside) for n in ("index", "attenuation")
        )
        pairs = zip(values, (index, attenuation), strict=True)
        index, attenuation = (dr.select(inside, value, before) for value, before in pairs)
    return SegmentMedium(index, attenuation)


@dataclass(frozen=True)
class AntennaPose:
    """Pose of the antenna at the end of a path.

    Attributes:
        position: position about the local origin [m].
        axes: rows of the radar's rotation.
    """

    position: mit.Point3f
    axes: list[mit.Vector3f]

    @staticmethod
    def look_up(
        inputs: Inputs, frame: mit.UInt32, receiver: Mask, active: Mask = True
    ) -> AntennaPose:
        """Gather the pose; a loop need not do so if it is gathered before.

        Args:
            inputs: inputs of the kernel.
            frame: radar poses.
            receiver: True for the receiver (a bool, or one per lane).
            active: mask of active lanes.
        """
        position = inputs.antenna_position(frame, receiver, active)
        return AntennaPose(position, radar_axes(inputs, frame, active))


@dataclass(frozen=True)
class AntennaConnection:
    """Last segment of a path, from a surface point to an antenna.

    Attributes:
        factor: f |cosθ| |cosθ'| G / R².
        distance: length R of the segment [m].
        direction: unit direction of the point in the radar frame.
    """

    factor: mit.Float
    distance: mit.Float
    direction: mit.Vector3f


def connect_antenna(
    inputs: Inputs,
    frame: mit.UInt32,
    point: SurfaceInteraction,
    incident: mit.Vector3f,
    receiver: Mask = True,
    active: Mask = True,
    *,
    antenna: AntennaPose,
    is_same_antenna: bool = False,
) -> AntennaConnection:
    """Evaluate the scattering from the incident direction towards an antenna.

    Args:
        inputs: inputs of the kernel.
        frame: radar poses.
        point: latest vertex.
        incident: unit directions from the vertex to the one before, or to the first antenna.
        receiver: True for the receiver (a bool, or one per lane).
        active: mask of active lanes.
        antenna: pose of the antenna.
        is_same_antenna: True if the path starts at that very antenna.
    """
    to_antenna, distance = direction_and_distance(point.position, antenna.position)
    in_radar_frame = project_to_axes(antenna.axes, -to_antenna)
    value = inputs.surfaces.evaluate_scattering(
        point.surface_row, point.normal, incident, None if is_same_antenna else to_antenna, active
    )
    gain = inputs.gain(frame, receiver, in_radar_frame)
    return AntennaConnection(value * gain / dr.square(distance), distance, in_radar_frame)
