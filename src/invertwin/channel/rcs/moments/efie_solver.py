"""Small conductors of any kind, open or closed, whose currents are solved on a mesh of their own.

Derivatives by vertices are those of the solution: S = c VᵀJ with M J = V changes by
c (dVᵀ J + λᵀ (dV − dM J)), where Mᵀ λ = V of the receiver. Small triangles move with those given.
"""

import math

import numpy as np
import torch
from jaxtyping import Bool, Complex128, Float64, Int64
from torch import Tensor

from invertwin.channel.em.plane_waves import cross, dot, phasor, polarisations
from invertwin.channel.rcs.moments.efie_matrix import EFIEMatrix, build_rwg_basis
from invertwin.channel.rcs.moments.meshing import ConformingMesh, build_conforming_mesh
from invertwin.channel.rcs.moments.solver import CurrentSolver, conserves_power
from invertwin.checks import is_differentiated
from invertwin.errors import InputError
from invertwin.scene import Mesh, signed_distance

MAX_UNKNOWNS = 12000
"""Unknowns up to which currents are solved: sides that two small triangles share."""
_MIN_UNKNOWNS_PER_SQUARE = 2.0  # unknowns in such a square, at least
_MAX_INTERIOR_POINTS = 160  # inside closed bodies, at most,
_INTERIOR_POINTS_PER_AREA = 2.5  # and for a square wavelength of their surface
_MAX_DEPTH = 0.6  # wavelengths, or less where bodies are thinner,
_DEPTH_SHARES = (0.3, 0.5)  # of which they are below the surface,
_MIN_CLEARANCE = 0.25  # and off all of it


class EFIESolver(CurrentSolver[ConformingMesh]):
    """Conductors whose currents are solved on triangles, see ``CurrentSolver``.

    Args:
        vertices: with or without derivatives [m].
        faces: their triangles.
        solid: whether a triangle is the skin of a closed body, its normal outwards.
        up: V lies in a plane with this unit vector.
    """

    MIN_SQUARES = 100

    def __init__(
        self,
        vertices: Float64[Tensor, "v 3"],
        faces: Int64[Tensor, "f 3"],
        solid: Bool[Tensor, " f"],
        up: Float64[Tensor, "3"],
    ) -> None:
        self.vertices, self.faces, self.solid, self.up = vertices, faces, solid, up
        corners = vertices[faces]
        self.double_area_vectors = torch.linalg.cross(
            corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        )
        super().__init__(float(self.double_area_vectors.detach().norm(dim=1).sum() / 2))

    def build_elements(self, side: float) -> ConformingMesh | None:
        """Small triangles that fit together, if they are not too many."""
        if max(self.area / side**2 * _MIN_UNKNOWNS_PER_SQUARE, len(self.faces)) > MAX_UNKNOWNS:
            return None
        mesh = build_conforming_mesh(self.vertices.detach().numpy(), self.faces.numpy(), side)
        if mesh is None or len(build_rwg_basis(mesh.faces).face) > MAX_UNKNOWNS:
            return None
        return mesh

    def assemble_equation(
        self, elements: ConformingMesh, wave_number: float, wave_count: int
    ) -> "_EFIEEquation":
        """See ``CurrentSolver.equation``.

        Raises:
            InputError: derivatives where vertices at one place were joined.
        """
        if is_differentiated(self.vertices) and elements.has_merged_vertices:
            raise InputError(
                "expected meshes without vertices at one place for derivatives of a small target, "
                "got some: currents stop where they part; join the meshes, or give edges=0 for "
                "physical optics alone"
            )
        return _EFIEEquation(self, elements, wave_number)


class _EFIEEquation:
    """The integral equation at one frequency, solved."""

    def __init__(self, target: EFIESolver, mesh: ConformingMesh, wave_number: float) -> None:
        self.k, self.up, self.target = wave_number, target.up, target
        functions = build_rwg_basis(mesh.faces)
        self.efie_matrix = EFIEMatrix(torch.from_numpy(mesh.faces), functions, wave_number)
        shares = torch.from_numpy(mesh.parent_weights)[..., None]
        self.vertices = (target.vertices[torch.from_numpy(mesh.parent_vertices)] * shares).sum(1)
        self.fixed_vertices = self.vertices.detach()
        self.interior_points = _sample_interior_points(target, self.vertices, mesh, wave_number)
        self.interior_matrix = self.efie_matrix.interior_field_matrix(
            self.fixed_vertices, self.interior_points.detach()
        )
        # Fields inside weigh as much as those on the surface.
        self.interior_weight = target.area / max(1, len(self.interior_matrix))
        # Memory in the order of columns, as LAPACK overwrites it.
        self.factors = self.efie_matrix.assemble(self.fixed_vertices).mT
        inner = self.interior_matrix.to(self.factors.dtype)
        self.factors.addmm_(inner.mH, inner, alpha=self.interior_weight)
        self.pivots = torch.zeros(self.efie_matrix.count, dtype=torch.int32)
        torch.linalg.lu_factor(self.factors, out=(self.factors, self.pivots))

    def solve_currents(
        self, transmitters: Float64[Tensor, "aspect 3"]
    ) -> Complex128[Tensor, "unknown aspect 2"]:
        """η J of plane waves of 1 V/m.

        Args:
            transmitters: the antennas.
        """
        right = self._excitation(self.fixed_vertices, transmitters)
        inside = self._incident_fields(self.interior_points.detach(), transmitters)
        right = right + self.interior_weight * torch.einsum(
            "yn,yat->nat", self.interior_matrix.conj(), inside
        )
        return self._solve(right, adjoint=False)

    def _solve(self, right: Tensor, *, adjoint: bool) -> Tensor:
        columns = right.flatten(1).to(self.factors.dtype)
        answer = torch.linalg.lu_solve(self.factors, self.pivots, columns, adjoint=adjoint)
        return answer.to(torch.complex128).view(right.shape)

    def _excitation(self, vertices: Tensor, directions: Tensor) -> Tensor:
        return self.efie_matrix.excitation(vertices, directions, polarisations(directions, self.up))

    def _incident_fields(self, points: Tensor, directions: Tensor) -> Tensor:
        """Fields of the waves at the places inside: [row, aspect, 2]."""
        wave = phasor(self.k * (points @ directions.T))
        field = polarisations(directions, self.up) + 0j
        return torch.einsum("ya,atx->yxat", wave, field).flatten(0, 1)

    def far_field(
        self, current: Tensor, transmitters: Tensor, receivers: Tensor
    ) -> Complex128[Tensor, "aspect 2 2"]:
        """S of currents, with derivatives where vertices move.

        Args:
            current: η J of the transmitters' waves.
            transmitters, receivers: where these are.
        """
        scale = -1j * self.k / (4 * math.pi)
        seen = self._excitation(self.fixed_vertices, receivers)
        value = scale * torch.einsum("nar,nat->art", seen, current)
        if not is_differentiated(self.target.vertices):
            return value
        # The solution of the transposed equation.
        back = self._solve(seen.conj(), adjoint=True).conj()
        change = torch.einsum("nar,nat->art", self._excitation(self.vertices, receivers), current)
        sent = self._excitation(self.vertices, transmitters)
        change = change + torch.einsum("nar,nat->art", back, sent)
        change = change - self.efie_matrix.bilinear(self.vertices, back, current)
        if len(self.interior_points):
            inner = self.efie_matrix.interior_field_matrix(self.vertices, self.interior_points)
            left = torch.einsum("yn,nat->yat", inner, current)
            left = self._incident_fields(self.interior_points, transmitters) - left
            taken = torch.einsum("yn,nar->yar", inner.conj(), back)
            some = (
                self.target.double_area_vectors[
                    self.target.double_area_vectors.detach().norm(dim=1) > 0
                ]
                .norm(dim=1)
                .sum()
            )
            weight = some / (2 * len(self.interior_matrix))
            change = change + weight * torch.einsum("yar,yat->art", taken, left)
        return value + scale * (change - change.detach())

    def conserves_power(self, current: Tensor, transmitters: Tensor) -> bool:
        """Whether the first wave's currents send out as much power as they take from the wave."""
        point, flowing = self.efie_matrix.sample_currents(self.fixed_vertices, current[:, 0])
        return conserves_power(
            self.k, point, flowing, -transmitters[0], polarisations(transmitters, self.up)[0]
        )


def _sample_interior_points(
    target: EFIESolver, vertices: Tensor, mesh: ConformingMesh, wave_number: float
) -> Float64[Tensor, "place 3"]:
    """Places inside closed bodies, which move with the surface below which they are."""
    origin = torch.from_numpy(mesh.parent_face)
    inside = torch.nonzero(target.solid[origin])[:, 0]
    if not len(inside):
        return torch.zeros(0, 3, dtype=torch.float64)
    wavelength = 2 * math.pi / wave_number
    wanted = min(
        _MAX_INTERIOR_POINTS, math.ceil(_INTERIOR_POINTS_PER_AREA * target.area / wavelength**2) + 8
    )
    # Even shares of the surface.
    inside = inside[:: max(1, len(inside) // wanted)]
    corners = target.vertices[target.faces]
    normal = torch.nn.functional.normalize(target.double_area_vectors, dim=1)
    start = vertices[torch.from_numpy(mesh.faces)[inside]].mean(1)
    mine = normal[origin[inside]]
    opposite, met = _find_opposite_faces(target, start.detach(), -mine.detach(), corners.detach())
    start, mine, opposite = start[met], mine[met], opposite[met]
    thick = dot(start - corners[opposite, 0], normal[opposite]) / dot(mine, normal[opposite])
    depth = torch.tensor(_DEPTH_SHARES, dtype=torch.float64).repeat(len(start))[: len(start)]
    room = thick.clamp_max(_MAX_DEPTH * wavelength)
    places = start - (depth * room)[:, None] * mine
    skin = Mesh(target.vertices.detach(), target.faces[target.solid])
    clear = signed_distance(skin, places.detach()).abs()
    return places[clear >= _MIN_CLEARANCE * room.detach()]


def _find_opposite_faces(
    target: EFIESolver, start: Tensor, direction: Tensor, corners: Tensor
) -> tuple[Tensor, Tensor]:
    """The first closed body's triangle that rays meet, and which rays do."""
    found, met = [], []
    size = 1e-9 * float(np.ptp(target.vertices.detach().numpy(), axis=0).max())
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    for origin, ray in zip(start, direction, strict=True):
        turned = cross(ray.expand_as(second), second)
        scale = dot(first, turned)
        safe = torch.where(scale == 0, torch.ones_like(scale), scale)
        away = origin - corners[:, 0]
        u = dot(away, turned) / safe
        across = torch.linalg.cross(away, first)
        v = dot(ray.expand_as(across), across) / safe
        far = dot(second, across) / safe
        hit = target.solid & (scale != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (far > size)
        far = torch.where(hit, far, math.inf)
        found.append(int(far.argmin()))
        met.append(bool(hit.any()))
    return torch.tensor(found, dtype=torch.int64), torch.tensor(met, dtype=torch.bool)
