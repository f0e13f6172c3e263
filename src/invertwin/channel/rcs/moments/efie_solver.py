"""Small conductors of any kind, open or closed, whose currents are solved on a mesh of their own.

Derivatives by vertices are those of the solution: S = c VᵀJ with M J = V changes by
c (dVᵀ J + λᵀ (dV − dM J)), where Mᵀ λ = V of the receiver. Small triangles move with those given.
"""

import math

import numpy as np
import torch
from jaxtyping import Bool, Complex128, Float64, Int64
from torch import Tensor

from invertwin.channel.em.plane_waves import cross, dot, polarisations, turned
from invertwin.channel.rcs.moments.efie_matrix import Moments, functions_of
from invertwin.channel.rcs.moments.meshing import Conforming, conforming
from invertwin.channel.rcs.moments.solver import Currents, keeps_power
from invertwin.checks import differentiated
from invertwin.errors import InputError
from invertwin.scene import Mesh, signed_distance

MOST_SIDES = 12000
"""Unknowns up to which currents are solved: sides that two small triangles share."""
_FEWEST = 2.0  # unknowns in such a square, at least
_PLACES = 160  # inside closed bodies, at most,
_PLACES_PER_AREA = 2.5  # and for a square wavelength of their surface
_DEEP = 0.6  # wavelengths, or less where bodies are thinner,
_DEPTHS = (0.3, 0.5)  # of which they are below the surface,
_CLEAR = 0.25  # and off all of it


class SolvedMeshes(Currents[Conforming]):
    """Conductors whose currents are solved on triangles, see ``Currents``.

    Args:
        vertices: with or without derivatives [m].
        faces: their triangles.
        solid: whether a triangle is the skin of a closed body, its normal outwards.
        up: V lies in a plane with this unit vector.
    """

    LEAST = 100

    def __init__(
        self,
        vertices: Float64[Tensor, "v 3"],
        faces: Int64[Tensor, "f 3"],
        solid: Bool[Tensor, " f"],
        up: Float64[Tensor, "3"],
    ) -> None:
        self.vertices, self.faces, self.solid, self.up = vertices, faces, solid, up
        corners = vertices[faces]
        self.double = torch.linalg.cross(
            corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        )
        super().__init__(float(self.double.detach().norm(dim=1).sum() / 2))

    def cut(self, side: float) -> Conforming | None:
        """Small triangles that fit together, if they are not too many."""
        if max(self.area / side**2 * _FEWEST, len(self.faces)) > MOST_SIDES:
            return None
        mesh = conforming(self.vertices.detach().numpy(), self.faces.numpy(), side)
        if mesh is None or len(functions_of(mesh.faces).face) > MOST_SIDES:
            return None
        return mesh

    def equation(self, pieces: Conforming, wave_number: float, waves: int) -> "_Equation":
        """See ``Currents.equation``.

        Raises:
            InputError: derivatives where vertices at one place were joined.
        """
        if differentiated(self.vertices) and pieces.seams:
            raise InputError(
                "expected meshes without vertices at one place for derivatives of a small target, "
                "got some: currents stop where they part; join the meshes, or give edges=0 for "
                "physical optics alone"
            )
        return _Equation(self, pieces, wave_number)


class _Equation:
    """The integral equation at one frequency, solved."""

    def __init__(self, target: SolvedMeshes, mesh: Conforming, wave_number: float) -> None:
        self.k, self.up, self.target = wave_number, target.up, target
        functions = functions_of(mesh.faces)
        self.moments = Moments(torch.from_numpy(mesh.faces), functions, wave_number)
        shares = torch.from_numpy(mesh.shares)[..., None]
        self.vertices = (target.vertices[torch.from_numpy(mesh.parents)] * shares).sum(1)
        self.still = self.vertices.detach()
        self.places = _places(target, self.vertices, mesh, wave_number)
        self.inner = self.moments.inside(self.still, self.places.detach())
        # Fields inside weigh as much as those on the surface.
        self.weight = target.area / max(1, len(self.inner))
        # Memory in the order of columns, as LAPACK overwrites it.
        self.factors = self.moments.matrix(self.still).mT
        inner = self.inner.to(self.factors.dtype)
        self.factors.addmm_(inner.mH, inner, alpha=self.weight)
        self.pivots = torch.zeros(self.moments.count, dtype=torch.int32)
        torch.linalg.lu_factor(self.factors, out=(self.factors, self.pivots))

    def currents(
        self, towards: Float64[Tensor, "aspect 3"]
    ) -> Complex128[Tensor, "unknown aspect 2"]:
        """η J of plane waves of 1 V/m.

        Args:
            towards: the antennas.
        """
        right = self._excited(self.still, towards)
        inside = self._arriving(self.places.detach(), towards)
        right = right + self.weight * torch.einsum("yn,yat->nat", self.inner.conj(), inside)
        return self._solved(right, adjoint=False)

    def _solved(self, right: Tensor, *, adjoint: bool) -> Tensor:
        columns = right.flatten(1).to(self.factors.dtype)
        answer = torch.linalg.lu_solve(self.factors, self.pivots, columns, adjoint=adjoint)
        return answer.to(torch.complex128).view(right.shape)

    def _excited(self, vertices: Tensor, towards: Tensor) -> Tensor:
        return self.moments.excited(vertices, towards, polarisations(towards, self.up))

    def _arriving(self, places: Tensor, towards: Tensor) -> Tensor:
        """Fields of the waves at the places inside: [row, aspect, 2]."""
        wave = turned(self.k * (places @ towards.T))
        field = polarisations(towards, self.up) + 0j
        return torch.einsum("ya,atx->yxat", wave, field).flatten(0, 1)

    def received(
        self, current: Tensor, transmitters: Tensor, receivers: Tensor
    ) -> Complex128[Tensor, "aspect 2 2"]:
        """S of currents, with derivatives where vertices move.

        Args:
            current: η J of the transmitters' waves.
            transmitters, receivers: where these are.
        """
        scale = -1j * self.k / (4 * math.pi)
        seen = self._excited(self.still, receivers)
        value = scale * torch.einsum("nar,nat->art", seen, current)
        if not differentiated(self.target.vertices):
            return value
        # The solution of the transposed equation.
        back = self._solved(seen.conj(), adjoint=True).conj()
        change = torch.einsum("nar,nat->art", self._excited(self.vertices, receivers), current)
        sent = self._excited(self.vertices, transmitters)
        change = change + torch.einsum("nar,nat->art", back, sent)
        change = change - self.moments.bilinear(self.vertices, back, current)
        if len(self.places):
            inner = self.moments.inside(self.vertices, self.places)
            left = torch.einsum("yn,nat->yat", inner, current)
            left = self._arriving(self.places, transmitters) - left
            taken = torch.einsum("yn,nar->yar", inner.conj(), back)
            some = self.target.double[self.target.double.detach().norm(dim=1) > 0].norm(dim=1).sum()
            weight = some / (2 * len(self.inner))
            change = change + weight * torch.einsum("yar,yat->art", taken, left)
        return value + scale * (change - change.detach())

    def keeps_power(self, current: Tensor, towards: Tensor) -> bool:
        """Whether the first wave's currents send out as much power as they take from the wave."""
        point, flowing = self.moments.sampled(self.still, current[:, 0])
        return keeps_power(self.k, point, flowing, -towards[0], polarisations(towards, self.up)[0])


def _places(
    target: SolvedMeshes, vertices: Tensor, mesh: Conforming, wave_number: float
) -> Float64[Tensor, "place 3"]:
    """Places inside closed bodies, which move with the surface below which they are."""
    origin = torch.from_numpy(mesh.origin)
    inside = torch.nonzero(target.solid[origin])[:, 0]
    if not len(inside):
        return torch.zeros(0, 3, dtype=torch.float64)
    wavelength = 2 * math.pi / wave_number
    wanted = min(_PLACES, math.ceil(_PLACES_PER_AREA * target.area / wavelength**2) + 8)
    # Even shares of the surface.
    inside = inside[:: max(1, len(inside) // wanted)]
    corners = target.vertices[target.faces]
    normal = torch.nn.functional.normalize(target.double, dim=1)
    start = vertices[torch.from_numpy(mesh.faces)[inside]].mean(1)
    mine = normal[origin[inside]]
    opposite, met = _opposite(target, start.detach(), -mine.detach(), corners.detach())
    start, mine, opposite = start[met], mine[met], opposite[met]
    thick = dot(start - corners[opposite, 0], normal[opposite]) / dot(mine, normal[opposite])
    depth = torch.tensor(_DEPTHS, dtype=torch.float64).repeat(len(start))[: len(start)]
    room = thick.clamp_max(_DEEP * wavelength)
    places = start - (depth * room)[:, None] * mine
    skin = Mesh(target.vertices.detach(), target.faces[target.solid])
    clear = signed_distance(skin, places.detach()).abs()
    return places[clear >= _CLEAR * room.detach()]


def _opposite(
    target: SolvedMeshes, start: Tensor, direction: Tensor, corners: Tensor
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
