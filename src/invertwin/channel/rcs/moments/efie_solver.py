"""EFIE solver (method of moments) for small conductors, open or closed, on a conforming mesh.

Derivatives with respect to vertices use the adjoint solution: S = c VᵀJ with M J = V changes by c
(dVᵀ J + λᵀ (dV − dM J)), where Mᵀ λ = V of the receiver. The small triangles move with the given
ones.
"""

import math

import numpy as np
import torch
from jaxtyping import Bool, Complex128, Float64, Int64
from torch import Tensor

from invertwin.channel.em import plane_waves as waves
from invertwin.channel.rcs.moments.efie_matrix import EFIEMatrix, build_rwg_basis
from invertwin.channel.rcs.moments.meshing import ConformingMesh, build_conforming_mesh
from invertwin.channel.rcs.moments.solver import CurrentSolver, Refusal, power_error, too_many
from invertwin.checks import is_differentiated
from invertwin.errors import InputError
from invertwin.scene import Mesh, signed_distance

MAX_UNKNOWNS = 12000
"""Maximum number of unknowns, sides that two small triangles share."""
_MIN_UNKNOWNS_PER_SQUARE = 2.0  # minimum number of unknowns per square of a side
_MAX_INTERIOR_POINTS = 160  # maximum number inside closed bodies
_INTERIOR_POINTS_PER_AREA = 2.5  # per square wavelength of their surface
_MAX_DEPTH = 0.6  # wavelengths, or the thickness of thinner bodies
_DEPTH_SHARES = (0.3, 0.5)  # of this depth: positions below the surface
_MIN_CLEARANCE = 0.25  # of this depth: distance to the whole surface


class EFIESolver(CurrentSolver[ConformingMesh]):
    """EFIE solver for conductors on triangles, see ``CurrentSolver``.

    Args:
        vertices: vertex positions, with or without derivatives [m].
        faces: vertex numbers of the triangles.
        solid: mask of triangles of closed bodies, with outward normals.
        up: unit vector of the vertical axis, in one plane with V.
    """

    MIN_SQUARES = 100
    ELEMENTS = "triangles"

    def __init__(
        self,
        vertices: Float64[Tensor, "v 3"],
        faces: Int64[Tensor, "f 3"],
        solid: Bool[Tensor, " f"],
        up: Float64[Tensor, "3"],
    ) -> None:
        self.vertices, self.faces, self.solid, self.up = vertices, faces, solid, up
        corners = vertices[faces]
        sides = corners[:, 1:] - corners[:, :1]
        self.double_area_vectors = torch.linalg.cross(sides[:, 0], sides[:, 1])
        super().__init__(float(self.double_area_vectors.detach().norm(dim=1).sum() / 2))

    def build_elements(self, side: float, refinement: int) -> ConformingMesh | Refusal:
        """Build a conforming mesh, see ``CurrentSolver.build_elements``."""
        side /= 2 ** (refinement / 2)
        count = max(self.area / side**2 * _MIN_UNKNOWNS_PER_SQUARE, len(self.faces))
        if refusal := too_many(count, MAX_UNKNOWNS, "unknowns"):
            return refusal
        mesh = build_conforming_mesh(self.vertices.detach().numpy(), self.faces.numpy(), side)
        if mesh is None:
            return Refusal("no valid triangles, as surfaces cross or touch")
        return too_many(len(build_rwg_basis(mesh.faces).face), MAX_UNKNOWNS, "unknowns") or mesh

    def assemble_equation(
        self, elements: ConformingMesh, wave_number: float, wave_count: int
    ) -> "_EFIEEquation":
        """Assemble the integral equation, see ``CurrentSolver.assemble_equation``.

        Raises:
            InputError: derivatives where coincident vertices were merged.
        """
        if is_differentiated(self.vertices) and elements.has_merged_vertices:
            raise InputError(
                "expected meshes without coincident vertices for derivatives of a small target, "
                "got some: currents end where they separate; merge the vertices, or give edges=0 "
                "for physical optics alone"
            )
        return _EFIEEquation(self, elements, wave_number)


class _EFIEEquation:
    """EFIE at one frequency, factorised."""

    def __init__(self, target: EFIESolver, mesh: ConformingMesh, wave_number: float) -> None:
        self.k, self.up, self.target = wave_number, target.up, target
        basis = build_rwg_basis(mesh.faces)
        self.efie_matrix = EFIEMatrix(torch.from_numpy(mesh.faces), basis, wave_number)
        weights = torch.from_numpy(mesh.parent_weights)[..., None]
        self.vertices = (target.vertices[torch.from_numpy(mesh.parent_vertices)] * weights).sum(1)
        self.fixed_vertices = self.vertices.detach()
        self.interior_points = _sample_interior_points(target, self.vertices, mesh, wave_number)
        inside = self.interior_points.detach()
        self.interior_matrix = self.efie_matrix.interior_field_matrix(self.fixed_vertices, inside)
        # Interior fields have the same total weight as those on the surface.
        self.interior_weight = target.area / max(1, len(self.interior_matrix))
        # Column-major memory, overwritten by LAPACK.
        self.factors = self.efie_matrix.assemble(self.fixed_vertices).mT
        interior = self.interior_matrix.to(self.factors.dtype)
        self.factors.addmm_(interior.mH, interior, alpha=self.interior_weight)
        self.pivots = torch.zeros(self.efie_matrix.count, dtype=torch.int32)
        torch.linalg.lu_factor(self.factors, out=(self.factors, self.pivots))

    def solve_currents(
        self, transmitters: Float64[Tensor, "aspect 3"]
    ) -> Complex128[Tensor, "unknown aspect 2"]:
        """Solve the currents η J of plane waves of 1 V/m.

        Args:
            transmitters: unit vectors to the transmitters.
        """
        right = self._excitation(self.fixed_vertices, transmitters)
        inside = self._incident_fields(self.interior_points.detach(), transmitters)
        interior = torch.einsum("yn,yat->nat", self.interior_matrix.conj(), inside)
        return self._solve(right + self.interior_weight * interior, adjoint=False)

    def _solve(self, right: Tensor, *, adjoint: bool) -> Tensor:
        columns = right.flatten(1).to(self.factors.dtype)
        answer = torch.linalg.lu_solve(self.factors, self.pivots, columns, adjoint=adjoint)
        return answer.to(torch.complex128).view(right.shape)

    def _excitation(self, vertices: Tensor, directions: Tensor) -> Tensor:
        return self.efie_matrix.excitation(
            vertices, directions, waves.polarisations(directions, self.up)
        )

    def _incident_fields(self, points: Tensor, directions: Tensor) -> Tensor:
        """Incident fields at points: [row, aspect, 2]."""
        wave = waves.phasor(self.k * (points @ directions.T))
        field = waves.polarisations(directions, self.up) + 0j
        return torch.einsum("ya,atx->yxat", wave, field).flatten(0, 1)

    def far_field(
        self, current: Tensor, transmitters: Tensor, receivers: Tensor
    ) -> Complex128[Tensor, "aspect 2 2"]:
        """Compute the far-field amplitudes S of currents, with derivatives if vertices move.

        Args:
            current: η J for the transmitters' waves.
            transmitters, receivers: unit vectors to the antennas.
        """
        scale = -1j * self.k / (4 * math.pi)
        received = self._excitation(self.fixed_vertices, receivers)
        value = scale * torch.einsum("nar,nat->art", received, current)
        if not is_differentiated(self.target.vertices):
            return value
        # Adjoint solution, of the transposed equation.
        adjoint = self._solve(received.conj(), adjoint=True).conj()
        change = torch.einsum("nar,nat->art", self._excitation(self.vertices, receivers), current)
        excitation = self._excitation(self.vertices, transmitters)
        change = change + torch.einsum("nar,nat->art", adjoint, excitation)
        change = change - self.efie_matrix.bilinear(self.vertices, adjoint, current)
        if len(self.interior_points):
            interior = self.efie_matrix.interior_field_matrix(self.vertices, self.interior_points)
            residual = torch.einsum("yn,nat->yat", interior, current)
            residual = self._incident_fields(self.interior_points, transmitters) - residual
            adjoint_field = torch.einsum("yn,nar->yar", interior.conj(), adjoint)
            double_area = self.target.double_area_vectors
            double_area = double_area[double_area.detach().norm(dim=1) > 0].norm(dim=1)
            weight = double_area.sum() / (2 * len(self.interior_matrix))
            change = change + weight * torch.einsum("yar,yat->art", adjoint_field, residual)
        return value + scale * (change - change.detach())

    def power_error(self, current: Tensor, transmitters: Tensor) -> float:
        """Relative error of the power balance of the first wave's currents (optical theorem)."""
        point, moments = self.efie_matrix.sample_currents(self.fixed_vertices, current[:, 0])
        sent = waves.polarisations(transmitters, self.up)[0]
        return power_error(self.k, point, moments, -transmitters[0], sent)


def _sample_interior_points(
    target: EFIESolver, vertices: Tensor, mesh: ConformingMesh, wave_number: float
) -> Float64[Tensor, "place 3"]:
    """Sample points inside closed bodies, which move with the surface above them."""
    origin = torch.from_numpy(mesh.parent_face)
    closed = torch.nonzero(target.solid[origin])[:, 0]
    if not len(closed):
        return torch.zeros(0, 3, dtype=torch.float64)
    wavelength = 2 * math.pi / wave_number
    count = math.ceil(_INTERIOR_POINTS_PER_AREA * target.area / wavelength**2) + 8
    count = min(_MAX_INTERIOR_POINTS, count)
    # Spread evenly over the surface.
    closed = closed[:: max(1, len(closed) // count)]
    corners = target.vertices[target.faces]
    normal = torch.nn.functional.normalize(target.double_area_vectors, dim=1)
    start = vertices[torch.from_numpy(mesh.faces)[closed]].mean(1)
    n = normal[origin[closed]]
    opposite, is_hit = _find_opposite_faces(target, start.detach(), -n.detach(), corners.detach())
    start, n, opposite = start[is_hit], n[is_hit], opposite[is_hit]
    thickness = waves.dot(start - corners[opposite, 0], normal[opposite]) / waves.dot(
        n, normal[opposite]
    )
    depth = torch.tensor(_DEPTH_SHARES, dtype=torch.float64).repeat(len(start))[: len(start)]
    max_depth = thickness.clamp_max(_MAX_DEPTH * wavelength)
    points = start - (depth * max_depth)[:, None] * n
    closed_mesh = Mesh(target.vertices.detach(), target.faces[target.solid])
    clearance = signed_distance(closed_mesh, points.detach()).abs()
    return points[clearance >= _MIN_CLEARANCE * max_depth.detach()]


def _find_opposite_faces(
    target: EFIESolver, start: Tensor, direction: Tensor, corners: Tensor
) -> tuple[Tensor, Tensor]:
    """First triangle of a closed body that rays hit, and the mask of rays that hit one."""
    size = 1e-9 * float(np.ptp(target.vertices.detach().numpy(), axis=0).max())
    first = corners[:, 0]
    normal = waves.cross(corners[:, 1] - first, corners[:, 2] - first)
    slope, offset = waves.dot(direction[:, None], normal), waves.dot(first - start[:, None], normal)
    distance = offset / torch.where(slope == 0, 1.0, slope)
    place = start[:, None] + distance[..., None] * direction[:, None]
    hit = target.solid & (slope != 0) & (distance > size)
    hit &= waves.barycentric_coordinates(corners, place).amin(2) >= 0
    return torch.where(hit, distance, math.inf).argmin(1), hit.any(1)
