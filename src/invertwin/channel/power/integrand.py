"""What one vertex of a path contributes, in Dr.Jit: the integrand of the path integral.

Everything here is differentiable or not, as its ``Inputs`` are. The torch form of these formulas,
in float64, is ``channel/coherent/radar_equation.py``; tests hold the two equal.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from torch import Tensor

from invertwin.channel.paths import GainPattern
from invertwin.channel.power.surface import SCATTERING_TABLES, ScatteringLawTables
from invertwin.channel.rays import arrays
from invertwin.channel.rays.arrays import (
    from_points,
    gather_points,
    interpolate_position,
    to_float,
    to_index,
    to_points,
    to_torch,
)
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.ray_scene import RayScene

#: The differentiable inputs of the kernel, in the order in which torch passes them.
DIFFERENTIABLE = ("vertices", "tx", "rx", "rotations", *SCATTERING_TABLES)
POINT_TABLES = DIFFERENTIABLE[:3]


def to_table(name: str, values: Tensor) -> Any:
    """A torch table as the kernel reads it.

    Args:
        name: Of the table.
        values: The torch table.
    """
    return to_points(values) if name in POINT_TABLES else to_float(values)


def from_table(name: str, values: Any, like: Tensor) -> Tensor:
    """The torch form of an array that is laid out as one of the tables.

    Args:
        name: Of the table.
        values: The array.
        like: The torch table that it is laid out as.
    """
    flat = from_points(values) if name in POINT_TABLES else to_torch(values)
    return flat.reshape(like.shape).to(like)


@dataclass(frozen=True)
class Inputs:
    """Flat Dr.Jit arrays; those named in ``DIFFERENTIABLE`` may carry derivatives."""

    vertices: Any  # as ``to_points`` has them, about the local origin [m]
    tx: Any  # place of the transmitter in every frame, likewise
    rx: Any
    rotations: Any  # of the radar in every frame
    surfaces: ScatteringLawTables
    faces: Any  # vertices of every triangle
    face_surface: Any  # row of every triangle's surface
    triangles: Any  # ``RayScene.triangles``: what is read where vertices carry no derivatives
    monostatic: bool  # both antennas are one
    tx_pattern: "PatternTable"
    rx_pattern: "PatternTable"
    scale: float  # (λ/4π)²
    coupling: tuple[float, float] = (1.0, 1.0)  # of paths with an odd, an even number of bounces

    @staticmethod
    def from_rays(rays: RayScene, *, monostatic: bool = False) -> "Inputs":
        """Upload a scene and its antennas; positions are taken about the local origin.

        Args:
            rays: Scene and antennas.
            monostatic: Spare one segment where both antennas are one, derivatives included: what
                is due to ``rx`` is then due to ``tx``.
        """
        link = rays.link
        return Inputs(
            vertices=rays.vertices,
            tx=rays.tx,
            rx=rays.rx,
            rotations=to_float(link.rotations),
            surfaces=ScatteringLawTables.from_geometry(rays.geometry),
            faces=rays.topology.device_corners,
            face_surface=to_index(rays.geometry.face_surface),
            triangles=rays.triangles,
            monostatic=monostatic,
            tx_pattern=PatternTable.from_pattern(link.tx_pattern),
            rx_pattern=PatternTable.from_pattern(link.rx_pattern),
            scale=(link.wavelength / (4 * np.pi)) ** 2,
        )

    def table(self, name: str) -> Any:
        """One of the differentiable inputs."""
        return self.surfaces.tables[name] if name in SCATTERING_TABLES else getattr(self, name)

    def with_tables(self, tables: dict[str, Any]) -> "Inputs":
        """With some of the differentiable inputs replaced."""
        rows = {name: table for name, table in tables.items() if name in SCATTERING_TABLES}
        others = {name: table for name, table in tables.items() if name not in SCATTERING_TABLES}
        surfaces = replace(self.surfaces, tables={**self.surfaces.tables, **rows})
        return replace(self, surfaces=surfaces, **others)

    def detach(self) -> "Inputs":
        """These values without derivatives."""
        return self.with_tables({name: dr.detach(self.table(name)) for name in DIFFERENTIABLE})

    def polarisation_factor(self, bounces: Any) -> Any:
        """What the antennas' polarisations take of paths with so many bounces."""
        odd, even = self.coupling
        return mi.Float(odd) if odd == even else dr.select((bounces & 1) == 1, odd, even)

    def antenna_position(self, frame: Any, receiver: Any, active: Any = True) -> Any:
        """Position of the receiver or the transmitter (a Python bool, or one per lane).

        Args:
            frame: Radar pose.
            receiver: Whether it is the receiver (a bool, or one per lane).
            active: Lanes.
        """
        if receiver is True or receiver is False:
            table = self.rx if receiver and not self.monostatic else self.tx
            return gather_points(table, frame, active)
        return dr.select(
            receiver,
            self.antenna_position(frame, True, active),
            self.antenna_position(frame, False, active),
        )

    def gain(self, frame: Any, receiver: Any, direction: Any) -> Any:
        """Linear power gain of the receiver or the transmitter towards a radar-frame direction.

        Args:
            frame: Radar pose.
            receiver: Whether it is the receiver (a bool, or one per lane).
            direction: Unit direction in the radar frame.
        """
        if receiver is True or receiver is False:
            return (self.rx_pattern if receiver else self.tx_pattern).gain(direction)
        return dr.select(receiver, self.rx_pattern.gain(direction), self.tx_pattern.gain(direction))


@dataclass(frozen=True)
class PatternTable:
    """An antenna pattern as the kernel reads it: bilinear in cosθ and φ."""

    values: Any  # gains, row after row
    shape: tuple[int, int]  # nodes in cosθ and φ
    constant_gain: float | None  # the gain, where it is the same everywhere

    @staticmethod
    def from_pattern(pattern: GainPattern) -> "PatternTable":
        table = pattern.table()
        rows, columns = int(table.shape[0]), int(table.shape[1])
        constant = float(table.reshape(-1)[0]) if rows * columns == 1 else None
        return PatternTable(to_float(table), (rows, columns), constant)

    def gain(self, direction: Any) -> Any:
        """Linear power gain for a unit direction in the radar frame."""
        if self.constant_gain is not None:
            return mi.Float(self.constant_gain)
        rows, columns = self.shape
        t = (dr.clip(direction.z, -1.0, 1.0) + 1) * (0.5 * (rows - 1))
        row = dr.minimum(mi.UInt32(dr.detach(t)), rows - 2)
        along = t - mi.Float(row)
        if columns == 1:
            low, high = (dr.gather(mi.Float, self.values, line) for line in (row, row + 1))
            return low + (high - low) * along
        s = (dr.atan2(direction.y, direction.x) / (2 * dr.pi) + 0.5) * columns
        column = dr.minimum(mi.UInt32(dr.detach(s)), columns - 1)
        across = s - mi.Float(column)
        nearby = (column + 1) % columns
        rows_of_gain = []
        for line in (row, row + 1):
            low = dr.gather(mi.Float, self.values, line * columns + column)
            high = dr.gather(mi.Float, self.values, line * columns + nearby)
            rows_of_gain.append(low + (high - low) * across)
        return rows_of_gain[0] + (rows_of_gain[1] - rows_of_gain[0]) * along


def corners(inputs: Inputs, face: Any, active: Any = True) -> tuple[Any, Any, Any]:
    """Corners of triangles, attached.

    Args:
        inputs: Tables of the kernel.
        face: Triangle.
        active: Lanes.
    """
    return arrays.corners(inputs.vertices, inputs.faces, face, active)


def edge_ends(inputs: Inputs, first: Any, second: Any) -> tuple[Any, Any]:
    """Ends of edges, attached.

    Args:
        inputs: Tables of the kernel.
        first, second: Vertices at the ends.
    """
    return gather_points(inputs.vertices, first), gather_points(inputs.vertices, second)


@dataclass(frozen=True)
class SurfaceInteraction:
    """A material point now; all but its surface is attached."""

    position: Any  # about the local origin [m]
    normal: Any  # of unit length
    jacobian: Any  # area of its triangle over that area detached: one in value
    surface_row: Any  # row of its surface

    @property
    def detached_state(self) -> dict[str, Any]:
        """What a loop carries of it, detached."""
        return {
            "position": mi.Point3f(dr.detach(self.position)),
            "normal": mi.Vector3f(dr.detach(self.normal)),
            "surface": self.surface_row,
        }

    @staticmethod
    def from_state(state: dict[str, Any]) -> "SurfaceInteraction":
        """What a loop has carried.

        Args:
            state: As ``state`` has them, among others.
        """
        return SurfaceInteraction(
            state["position"], state["normal"], mi.Float(1.0), state["surface"]
        )


def compute_interaction(
    inputs: Inputs, face: Any, b1: Any, b2: Any, active: Any = True
) -> SurfaceInteraction:
    """Where a pair of barycentric coordinates lies now.

    Args:
        inputs: Tables of the kernel.
        face: Triangle.
        b1, b2: Barycentric coordinates.
        active: Lanes.
    """
    surface = dr.gather(mi.UInt32, inputs.face_surface, face, active)
    if not dr.grad_enabled(inputs.vertices):
        p0, first, second = (
            dr.gather(mi.Vector4f, inputs.triangles, face * 3 + k, active) for k in range(3)
        )
        position = mi.Point3f(p0.xyz + b1 * first.xyz + b2 * second.xyz)
        normal = mi.Vector3f(p0.w, first.w, second.w)
        return SurfaceInteraction(position, normal, mi.Float(1.0), surface)
    triangle = p0, p1, p2 = corners(inputs, face, active)
    normal = dr.cross(p1 - p0, p2 - p0)
    double_area = dr.norm(normal)
    return SurfaceInteraction(
        position=interpolate_position(triangle, b1, b2),
        normal=normal / double_area,
        jacobian=double_area / dr.detach(double_area),
        surface_row=surface,
    )


@dataclass(frozen=True)
class SurfacePoint:
    """A point of a surface.

    Attributes:
        face: Triangle.
        b1, b2: Barycentric coordinates.
    """

    face: Any
    b1: Any
    b2: Any

    def compute_interaction(self, inputs: Inputs, active: Any = True) -> SurfaceInteraction:
        """Where it is.

        Args:
            inputs: Tables of the kernel.
            active: Lanes.
        """
        return compute_interaction(inputs, self.face, self.b1, self.b2, active)


def pull_interaction(
    inputs: Inputs,
    face: Any,
    b1: Any,
    b2: Any,
    active: Any,
    position: Any,
    normal: Any,
    jacobian: Any,
) -> None:
    """The adjoint of ``compute_interaction``, written out: add to the gradient of the corners.

    Args:
        inputs: Attached tables.
        face: Triangle.
        b1, b2: Barycentric coordinates.
        active: Lanes.
        position, normal, jacobian: Derivatives of the loss by what ``compute_interaction`` gives.
    """
    first, second = (
        dr.gather(mi.Vector4f, inputs.triangles, face * 3 + k, active).xyz for k in (1, 2)
    )
    crossed = dr.cross(first, second)
    scale = dr.rsqrt(dr.squared_norm(crossed))
    unit = crossed * scale
    # By the cross product of the sides, then by these.
    turn = (normal + unit * (jacobian - dr.dot(unit, normal))) * scale
    by_first, by_second = dr.cross(second, turn), dr.cross(turn, first)
    bars = (
        position * (1 - b1 - b2) - by_first - by_second,
        position * b1 + by_first,
        position * b2 + by_second,
    )
    # Only the derivatives of this sum count: its value is never computed.
    corner = corners(inputs, face, active)
    dr.backward_from(sum(dr.dot(point, bar) for point, bar in zip(corner, bars, strict=True)))


def direction_and_distance(start: Any, end: Any) -> tuple[Any, Any]:
    """Unit direction and distance from one point to another.

    Args:
        start, end: Of the segment.
    """
    offset = end - start
    distance = dr.norm(offset)
    return offset / distance, distance


def to_radar_frame(inputs: Inputs, frame: Any, direction: Any, active: Any = True) -> Any:
    """World direction in the radar frame (the rotation's columns are the radar's axes).

    Args:
        inputs: Tables of the kernel.
        frame: Radar pose.
        direction: Unit direction in the world.
        active: Lanes.
    """
    return project_to_axes(radar_axes(inputs, frame, active), direction)


def radar_axes(inputs: Inputs, frame: Any, active: Any = True) -> list[Any]:
    """Rows of the radar's rotation.

    Args:
        inputs: Tables of the kernel.
        frame: Radar pose.
        active: Lanes.
    """
    return [dr.gather(mi.Vector3f, inputs.rotations, frame * 3 + k, active) for k in range(3)]


def project_to_axes(rows: list[Any], direction: Any) -> Any:
    """World direction in the radar frame.

    Args:
        rows: Of the radar's rotation.
        direction: Unit direction in the world.
    """
    return mi.Vector3f(*(sum(rows[k][axis] * direction[k] for k in range(3)) for axis in range(3)))


@dataclass(frozen=True)
class SegmentMedium:
    """What a segment runs through."""

    refractive_index: Any  # refractive
    attenuation: Any  # of power [1/m]


def find_medium(
    inputs: Inputs,
    start: SurfaceInteraction,
    end: SurfaceInteraction | None,
    direction: Any,
    active: Any,
) -> SegmentMedium:
    """The body inside of which a segment runs, if any: that of a skin it leaves or meets inside.

    Args:
        inputs: Tables.
        start: Where it starts.
        end: Where it ends; None for an antenna.
        direction: Unit direction from start to end.
        active: Lanes.
    """
    index, attenuation = mi.Float(1.0), mi.Float(0.0)
    ends = ((start, 1.0),) if end is None else ((start, 1.0), (end, -1.0))
    for place, sign in ends if inputs.surfaces.has_refracting_bodies else ():
        inside = active & (dr.detach(dr.dot(place.normal, direction)) * sign < 0)
        inside &= inputs.surfaces.is_refracting(place.surface_row)
        values = (
            inputs.surfaces.value(n, place.surface_row, inside) for n in ("index", "attenuation")
        )
        index, attenuation = (
            dr.select(inside, value, so_far)
            for value, so_far in zip(values, (index, attenuation), strict=True)
        )
    return SegmentMedium(index, attenuation)


@dataclass(frozen=True)
class AntennaPose:
    """An antenna that a path ends at. To look it up before a loop spares the loop doing so."""

    position: Any  # about the local origin [m]
    axes: list[Any]  # rows of the radar's rotation

    @staticmethod
    def look_up(inputs: Inputs, frame: Any, receiver: Any, active: Any = True) -> "AntennaPose":
        """Look it up.

        Args:
            inputs: Tables of the kernel.
            frame: Radar pose.
            receiver: Whether it is the receiver (a bool, or one per lane).
            active: Lanes.
        """
        return AntennaPose(
            inputs.antenna_position(frame, receiver, active), radar_axes(inputs, frame, active)
        )


@dataclass(frozen=True)
class AntennaConnection:
    """The last segment of a path, from a surface point to an antenna."""

    factor: Any  # f |cosθ| |cosθ'| G / R²
    distance: Any  # R [m]
    direction: Any  # direction of the point in the radar frame


def connect_antenna(
    inputs: Inputs,
    frame: Any,
    point: SurfaceInteraction,
    incident: Any,
    receiver: Any = True,
    active: Any = True,
    *,
    is_same_antenna: bool = False,
    antenna: AntennaPose | None = None,
) -> AntennaConnection:
    """Scatter what comes from ``incident`` towards an antenna; ``is_same_antenna`` if it lies
    there.

    Args:
        inputs: Tables of the kernel.
        frame: Radar pose.
        point: The vertex.
        incident: Unit direction from where the path comes.
        receiver: Whether the antenna is the receiver (a bool, or one per lane).
        active: Lanes.
        is_same_antenna: Whether the path comes from that very antenna.
        antenna: The antenna, where it has been looked up.
    """
    antenna = antenna or AntennaPose.look_up(inputs, frame, receiver, active)
    to_antenna, distance = direction_and_distance(point.position, antenna.position)
    seen = project_to_axes(antenna.axes, -to_antenna)
    on = None if is_same_antenna else to_antenna
    value = inputs.surfaces.evaluate_scattering(
        point.surface_row, point.normal, incident, on, active
    )
    gain = inputs.gain(frame, receiver, seen)
    return AntennaConnection(value * gain / dr.square(distance), distance, seen)
