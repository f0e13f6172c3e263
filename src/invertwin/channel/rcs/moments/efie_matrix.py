"""The electric field integral equation of conductors on triangles, open or closed.

Currents flow across the sides of small triangles. Each side's function is linear on its two
triangles; where more meet at a side, the first one has a function with each of the others. Products
of the equation with the same functions make a symmetric matrix, so that fields are reciprocal.
Integrals over triangles that are far apart are sums over points. Near ones have 1/R in closed form.

A closed body has resonances inside, at which the equation does not say which current flows. The
field at places inside has to vanish too, which is added as least squares.

Source: Rao, Wilton and Glisson, "Electromagnetic scattering by surfaces of arbitrary shape", IEEE
TAP 30, 1982; Wilton et al., "Potential integrals for uniform and linear source distributions on
polygonal and polyhedral domains", IEEE TAP 32, 1984; Van Oosterom and Strackee, "The solid angle of
a plane triangle", IEEE TBME 30, 1983.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Complex, Complex128, Float64, Int64
from scipy.sparse import coo_array, csr_array
from scipy.spatial import KDTree
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from invertwin.channel.em.plane_waves import cross, dot, phasor

_NEAR_RATIO = 1.6  # of the radii of two triangles, up to which their distance counts as near
_MAX_DOUBLE_UNKNOWNS = 2500  # unknowns up to which all is in double precision
_ENTRIES_AT_ONCE = 1 << 22
_PAIRS_AT_ONCE = 1 << 14
_ASPECTS_AT_ONCE = 32
_MIN_DISTANCE = 1e-12  # of the wavelength: nearer places are one


def _symmetric_quadrature(*orbits: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """Shares and weights of points: each orbit has one large or small share, and a weight."""
    shares = [
        [far if turn == at else (1 - far) / 2 for at in range(3)]
        for far, _ in orbits
        for turn in range(3 if far != 1 / 3 else 1)
    ]
    weights = [weight for far, weight in orbits for _ in range(3 if far != 1 / 3 else 1)]
    return torch.tensor(shares, dtype=torch.float64), torch.tensor(weights, dtype=torch.float64)


QUADRATURE_3 = _symmetric_quadrature((2 / 3, 1 / 3))
QUADRATURE_7 = _symmetric_quadrature(
    (1 / 3, 0.225), (0.059715871789770, 0.132394152788506), (0.797426985353087, 0.125939180544827)
)


@dataclass(frozen=True)
class RWGBasis:
    """Where currents flow, one row for each side of triangles that it crosses.

    Attributes:
        face: from which triangle, and to which.
        corner: of these, opposite to the side.
    """

    face: Int64[Tensor, "unknown 2"]
    corner: Int64[Tensor, "unknown 2"]


def build_rwg_basis(faces: Int64[np.ndarray, "face 3"]) -> RWGBasis:
    """All functions of a mesh that fits together.

    Args:
        faces: vertices of the triangles.
    """
    ends = np.sort(np.stack([np.roll(faces, -1, 1), np.roll(faces, -2, 1)], 2).reshape(-1, 2), 1)
    order = np.lexsort(ends.T)
    new = np.ones(len(order), dtype=bool)
    new[1:] = (ends[order[1:]] != ends[order[:-1]]).any(1)
    first = order[np.flatnonzero(new)[new.cumsum() - 1]]
    pairs = torch.from_numpy(np.stack([first, order], 1)[~new])
    return RWGBasis(pairs // 3, pairs % 3)


class EFIEMatrix:
    """The equation of a mesh at one frequency.

    Args:
        faces: vertices of the triangles.
        basis: where currents flow.
        wave_number: k [1/m].
    """

    def __init__(self, faces: Int64[Tensor, "face 3"], basis: RWGBasis, wave_number: float) -> None:
        self.faces, self.basis, self.k = faces, basis, wave_number
        self.count = len(basis.face)
        self.real_dtype = torch.float64 if self.count <= _MAX_DOUBLE_UNKNOWNS else torch.float32
        self.complex_dtype = self.real_dtype.to_complex()

    def excitation(
        self,
        vertices: Float64[Tensor, "v 3"],
        directions: Float64[Tensor, "aspect 3"],
        fields: Float64[Tensor, "aspect field 3"],
    ) -> Complex128[Tensor, "unknown aspect field"]:
        """∫ f·E exp(jk u·x) of all functions f.

        Args:
            vertices: [m].
            directions: u, unit vectors to where waves come from, or go to.
            fields: E.
        """
        corners = vertices[self.faces]
        shares, weights = QUADRATURE_7
        middle = corners.mean(1)
        beside = shares @ (corners - middle[:, None])
        turn = self.k * ((beside + middle[:, None]) @ directions.T)
        wave = phasor(turn) * weights[:, None] / 2
        along = torch.einsum("fqa,fqx,atx->fat", wave, beside + 0j, fields + 0j)
        level = torch.einsum("fvx,atx->fvat", corners - middle[:, None], fields)
        local = along[:, None] - wave.sum(1)[:, None, :, None] * level
        return self._combine_halves(local)

    def _combine_halves(self, local: Tensor) -> Tensor:
        """Of functions, from what each corner's half of them has on every triangle."""
        face, corner = self.basis.face, self.basis.corner
        return local[face[:, 0], corner[:, 0]] - local[face[:, 1], corner[:, 1]]

    def half_coefficients(
        self, current: Complex[Tensor, "unknown *column"]
    ) -> Complex[Tensor, "face 3 *column"]:
        """How strong each corner's half is on every triangle.

        Args:
            current: across all sides.
        """
        face, corner = self.basis.face, self.basis.corner
        shape = (3 * len(self.faces), *current.shape[1:])
        found = torch.zeros(shape, dtype=current.dtype)
        for half, sign in ((0, 1.0), (1, -1.0)):
            found.index_add_(0, 3 * face[:, half] + corner[:, half], sign * current)
        return found.view(len(self.faces), 3, *current.shape[1:])

    def near_pairs(self, vertices: Float64[Tensor, "v 3"]) -> Int64[Tensor, "pair 2"]:
        """Pairs of triangles whose integrals are not sums over points, each with itself too.

        Args:
            vertices: [m].
        """
        corners = vertices[self.faces]
        middle = corners.mean(1)
        radius = (corners - middle[:, None]).norm(dim=2).amax(1)
        tree = KDTree(middle.numpy())
        pairs = tree.query_pairs(2 * _NEAR_RATIO * float(radius.max()), output_type="ndarray")
        pairs = torch.from_numpy(pairs.astype(np.int64))
        apart = (middle[pairs[:, 0]] - middle[pairs[:, 1]]).norm(dim=1)
        pairs = pairs[apart < _NEAR_RATIO * radius[pairs].sum(1)]
        own = torch.arange(len(self.faces))[:, None].expand(-1, 2)
        pairs = torch.cat([own, pairs, pairs.flip(1)])
        return pairs[(pairs[:, 0] * len(self.faces) + pairs[:, 1]).argsort()]

    def assemble(self, vertices: Float64[Tensor, "v 3"]) -> Complex[Tensor, "unknown unknown"]:
        """Z: jk ∫∫ (f·f′ − ∇·f ∇·f′/k²) G of all functions.

        Args:
            vertices: [m], without derivatives.
        """
        pairs = self.near_pairs(vertices)
        total = self._far_interactions(vertices, pairs)
        face, corner = self.basis.face.numpy(), self.basis.corner.numpy()
        every = np.arange(self.count)
        row = np.concatenate([every, every])
        spot = (3 * face + corner).T.ravel()
        sign = np.repeat([1.0, -1.0], self.count)
        halves = csr_array((sign, (row, spot)), shape=(self.count, 3 * len(self.faces)))
        parts = torch.cat(
            [self._near_interactions(vertices, some) for some in pairs.split(_PAIRS_AT_ONCE)]
        ).numpy()
        at = 3 * pairs.numpy()[:, :, None] + np.arange(3)
        rows = np.broadcast_to(at[:, 0, :, None], parts.shape).ravel()
        columns = np.broadcast_to(at[:, 1, None, :], parts.shape).ravel()
        local = coo_array((parts.ravel(), (rows, columns)), shape=(3 * len(self.faces),) * 2)
        close = (halves @ local.tocsr() @ halves.T).tocoo()
        close.sum_duplicates()
        place = torch.from_numpy(close.row.astype(np.int64) * self.count + close.col)
        total.view(-1)[place] += torch.from_numpy(close.data / 2).to(total.dtype)
        # Each pair's integrals stand above or below, or half in both.
        size = max(1, _ENTRIES_AT_ONCE // self.count)
        for begin in range(0, self.count, size):
            some = slice(begin, begin + size)
            both = total[some, begin:] + total[begin:, some].mT
            total[some, begin:] = both
            total[begin:, some] = both.mT
        return total.mul_(1j * self.k)

    def _far_interactions(self, vertices: Tensor, pairs: Tensor) -> Tensor:
        """Over jk, of one order of each two triangles that are not near."""
        count = len(self.faces)
        points, products = self._quadrature_points(vertices)
        points = points.to(self.real_dtype).reshape(-1, 3)

        face, corner = self.basis.face.numpy(), self.basis.corner.numpy()
        shape = (self.count, 3 * count)
        parts = []
        for part in products.numpy().transpose(3, 0, 1, 2).astype(points.numpy().dtype):
            value, place = [], []
            for half, sign in ((0, 1.0), (1, -1.0)):
                value.append(sign * part[face[:, half], corner[:, half]])
                place.append(3 * face[:, half, None] + np.arange(3))
            row = np.repeat(np.arange(self.count), 3)
            spots = (np.concatenate([row, row]), np.concatenate([p.ravel() for p in place]))
            # Integers of 32 bits and single precision stay what they are.
            parts.append(
                csr_array((np.concatenate([v.ravel() for v in value]), spots), shape=shape)
            )
        scale = [1.0, 1.0, 1.0, -1 / self.k**2]
        total = torch.zeros(self.count, self.count, dtype=self.complex_dtype)
        bounds = torch.searchsorted(pairs[:, 0].contiguous(), torch.arange(count + 1))
        size = max(1, _ENTRIES_AT_ONCE // (9 * count))
        for begin in range(0, count, size):
            end = min(begin + size, count)
            aside = pairs[bounds[begin] : bounds[end]]
            aside = aside[aside[:, 1] >= begin]
            kernel = self._greens_function(points[3 * begin :], points[3 * begin : 3 * end])
            kernel[:, : 3 * (end - begin)] /= 2
            blocked = kernel.view(2, count - begin, 3, end - begin, 3)
            blocked[:, aside[:, 1] - begin, :, aside[:, 0] - begin] = 0
            flat = kernel.permute(1, 0, 2).reshape(len(points) - 3 * begin, -1).numpy()
            mine = np.flatnonzero(((face >= begin) & (face < end)).any(1))
            found = torch.zeros(2 * self.count, len(mine), dtype=self.real_dtype)
            for part, share in zip(parts, scale, strict=True):
                sent = torch.from_numpy(part[:, 3 * begin :] @ flat)
                left = part[mine, 3 * begin : 3 * end].toarray()
                found.addmm_(sent.view(2 * self.count, -1), torch.from_numpy(left).T, alpha=share)
            both = found.view(self.count, 2, len(mine)).permute(2, 0, 1).contiguous()
            total[torch.from_numpy(mine)] += torch.view_as_complex(both)
        return total

    def _quadrature_points(self, vertices: Tensor) -> tuple[Tensor, Tensor]:
        """Three points of every triangle, and of its halves ∫ f and ∫ ∇·f there.

        Returns:
            [face, point, 3] and [face, corner, point, x y z and divergence].
        """
        corners = vertices[self.faces]
        middle = corners.mean(1)
        shares, weights = QUADRATURE_3
        beside = shares @ (corners - middle[:, None])
        along = beside[:, None] - (corners - middle[:, None])[:, :, None]
        whole = torch.ones_like(along[..., :1])
        products = torch.cat([along / 2, whole], -1) * weights[:, None]
        return beside + (middle - vertices.detach().mean(0))[:, None], products

    def _greens_function(self, points: Tensor, others: Tensor) -> Tensor:
        """Real and imaginary part of G between places: [2, point, other]."""
        square = torch.zeros(len(points), len(others), dtype=points.dtype)
        for axis in range(3):
            square = square + (points[:, None, axis] - others[:, axis]).square()
        apart = (square + (_MIN_DISTANCE / self.k) ** 2).sqrt()
        turn, level = self.k * apart, 1 / (4 * math.pi * apart)
        return torch.stack([turn.cos() * level, -turn.sin() * level])

    def _near_interactions(self, vertices: Tensor, pairs: Tensor) -> Tensor:
        """Over jk, of the halves on two triangles each: [pair, 3, 3].

        The other triangle's 1/R is integrated in closed form; what is left of G is smooth.
        """
        here, there = (vertices[self.faces[pairs[:, side]]] for side in (0, 1))
        centre, middle = here.mean(1), there.mean(1)
        shares, weights = QUADRATURE_7
        point = shares @ here
        flat, sloped, _ = self._triangle_fields(there, point)
        along = (point - centre[:, None])[:, None] - (here - centre[:, None])[:, :, None]
        along = along * (weights / 4)[:, None]
        offset = (there - middle[:, None]) + 0j
        inner = sloped[:, :, None] - flat[..., None, None] * offset[:, None]
        found = torch.einsum("piqx,pqjx->pij", along + 0j, inner)
        return found - ((weights * flat).sum(1) / self.k**2)[:, None, None]

    def _triangle_fields(
        self, corners: Tensor, points: Tensor, *, gradient: bool = False
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Of triangles' even and linear currents (from their middle on) at points, over their area.

        1/R is integrated in closed form; what is left of exp(−jkR)/R is smooth.

        Returns:
            [triangle, point], [triangle, point, 3], and the gradient of the first, if asked for.
        """
        middle = corners.mean(1)[:, None]
        shares, weights = QUADRATURE_7
        spot = shares @ corners
        level, first, slope = triangle_potentials(corners, points)
        double = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        scale = 1 / (2 * math.pi * double.norm(dim=1))[:, None]
        away = points[:, :, None] - spot[:, None]
        apart = (dot(away, away) + (_MIN_DISTANCE / self.k) ** 2).sqrt()
        turn = self.k * apart
        # exp(−jkR) − 1 without cancellation.
        rest = torch.complex(-2 * (turn / 2).sin().square(), -turn.sin())
        smooth = rest / (4 * math.pi * apart) * weights
        flat = level * scale + smooth.sum(2)
        sloped = (first + (points - middle) * level[..., None]) * scale[..., None]
        sloped = sloped + torch.einsum("pqr,prx->pqx", smooth, (spot - middle) + 0j)
        if not gradient:
            return flat, sloped, None
        fall = -(1j * turn * phasor(-turn) + rest) / (4 * math.pi * apart**3) * weights
        return flat, sloped, slope * scale[..., None] + (fall[..., None] * away).sum(2)

    def bilinear(
        self,
        vertices: Float64[Tensor, "v 3"],
        left: Complex128[Tensor, "unknown aspect p"],
        right: Complex128[Tensor, "unknown aspect q"],
    ) -> Complex128[Tensor, "aspect p q"]:
        """Lᵀ Z R of each aspect's currents, with derivatives, block by block.

        Args:
            vertices: [m].
            left, right: L and R.
        """
        pairs = self.near_pairs(vertices.detach())
        ends = (self.half_coefficients(left), self.half_coefficients(right))
        aspects = torch.arange(left.shape[1]).split(_ASPECTS_AT_ONCE)
        parts = [
            self._bilinear_block(vertices, pairs, *(end[:, :, some] for end in ends))
            for some in aspects
        ]
        return 1j * self.k * torch.cat(parts)

    def _bilinear_block(
        self, vertices: Tensor, pairs: Tensor, left: Tensor, right: Tensor
    ) -> Tensor:
        count = len(self.faces)
        points, products = self._quadrature_points(vertices)
        points = points.to(self.real_dtype).reshape(-1, 3)
        scale = products.new_tensor([1.0, 1.0, 1.0, 1 / self.k])
        scale = torch.complex(
            scale * products.new_tensor([1.0, 1, 1, 0]), scale * products.new_tensor([0.0, 0, 0, 1])
        )
        # The divergence's share j/k, twice, makes −1/k².
        strengths = [
            torch.einsum("fcqz,fcap->fqapz", products * scale, half)
            .flatten(0, 1)
            .to(self.complex_dtype)
            for half in (left, right)
        ]
        bounds = torch.searchsorted(pairs[:, 0].contiguous(), torch.arange(count + 1))
        size = max(1, _ENTRIES_AT_ONCE // (9 * count))

        def far_block(
            points: Tensor, left_strengths: Tensor, right_strengths: Tensor, begin: int
        ) -> Tensor:
            end = min(begin + size, count)
            aside = pairs[bounds[begin] : bounds[end]]
            mask = torch.ones(end - begin, count, dtype=points.dtype)
            mask[aside[:, 0] - begin, aside[:, 1]] = 0
            mask = mask.repeat_interleave(3, 0).repeat_interleave(3, 1)
            kernel = self._greens_function(points[3 * begin : 3 * end], points) * mask
            kernel = torch.complex(kernel[0], kernel[1])
            field = (kernel @ right_strengths.flatten(1)).view(
                len(kernel), *right_strengths.shape[1:]
            )
            some = left_strengths[3 * begin : 3 * end]
            return torch.einsum("eapz,eaqz->apq", some, field).to(torch.complex128)

        def near_block(vertices: Tensor, some: Tensor) -> Tensor:
            local = self._near_interactions(vertices, some) / 2
            here, there = some.unbind(1)
            # The mean of both orders, as in the matrix.
            field = torch.einsum("nij,njaq->niaq", local, right[there])
            back = torch.einsum("nij,niaq->njaq", local, right[here])
            found = torch.einsum("niap,niaq->apq", left[here], field)
            return found + torch.einsum("njap,njaq->apq", left[there], back)

        total = torch.zeros(*left.shape[2:], right.shape[-1], dtype=torch.complex128)
        for begin in range(0, count, size):
            total = total + checkpoint(far_block, points, *strengths, begin, use_reentrant=False)
        for some in pairs.split(_PAIRS_AT_ONCE):
            total = total + checkpoint(near_block, vertices, some, use_reentrant=False)
        return total

    def sample_currents(
        self, vertices: Float64[Tensor, "v 3"], current: Complex128[Tensor, "unknown column"]
    ) -> tuple[Float64[Tensor, "point 3"], Complex128[Tensor, "point column 3"]]:
        """Places, and J dA there.

        Args:
            vertices: [m].
            current: across all sides.
        """
        points, products = self._quadrature_points(vertices)
        flowing = torch.einsum(
            "fiqx,fic->fqcx", products[..., :3] + 0j, self.half_coefficients(current)
        )
        return points.flatten(0, 1) + vertices.detach().mean(0), flowing.flatten(0, 1)

    def interior_field_matrix(
        self, vertices: Float64[Tensor, "v 3"], interior_points: Float64[Tensor, "place 3"]
    ) -> Complex128[Tensor, "row unknown"]:
        """x, y and z of the field that must reach places for currents to cancel it there.

        Args:
            vertices: [m].
            interior_points: off the surface [m].
        """
        corners = vertices[self.faces]
        offset = corners - corners.mean(1)[:, None]

        def evaluate_chunk(some: Tensor) -> Tensor:
            points = some.expand(len(corners), -1, 3)
            flat, sloped, charge = self._triangle_fields(corners, points, gradient=True)
            assert charge is not None
            part = sloped[:, None] - flat[:, None, :, None] * offset[:, :, None]
            return self._combine_halves(0.5j * self.k * part + 1j / self.k * charge[:, None])

        size = max(1, (_ENTRIES_AT_ONCE >> 6) // len(corners))
        found = [
            checkpoint(evaluate_chunk, some, use_reentrant=False)
            for some in interior_points.split(size)
        ]
        return torch.cat(found, 1).flatten(1).T


def triangle_potentials(
    corners: Float64[Tensor, "row 3 3"], points: Float64[Tensor, "row point 3"]
) -> tuple[
    Float64[Tensor, "row point"], Float64[Tensor, "row point 3"], Float64[Tensor, "row point 3"]
]:
    """Potentials 1/R of triangles in closed form.

    Args:
        corners: of the triangles.
        points: x, on no side.

    Returns:
        ∫ 1/R dy, ∫ (y − x)/R dy, and the gradient of the first by x.

    Source: Wilton et al. 1984, with the logarithm as ln((R⁺ + R⁻ + L)/(R⁺ + R⁻ − L)), and the sum
    of arcs as the solid angle of Van Oosterom and Strackee.
    """
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = (normal / normal.norm(dim=1, keepdim=True))[:, None]
    away = [corners[:, None, v] - points for v in range(3)]
    far = [vector.norm(dim=-1) for vector in away]
    height = -dot(away[0], normal)
    level = torch.zeros_like(height)
    first = torch.zeros_like(points)
    slope = torch.zeros_like(points)
    for v in range(3):
        w = (v + 1) % 3
        side = (corners[:, w] - corners[:, v])[:, None]
        length = side.norm(dim=-1)
        along = side / length[..., None]
        outwards = cross(along, normal)
        distance = dot(away[v], outwards)
        both = far[v] + far[w]
        logarithm = ((both + length) / (both - length)).log()
        level = level + distance * logarithm
        slope = slope - outwards * logarithm[..., None]
        square = distance.square() + height.square()
        ends = dot(away[w], along) * far[w] - dot(away[v], along) * far[v]
        first = first + outwards * ((square * logarithm + ends) / 2)[..., None]
    a, b, c = away
    volume = dot(a, torch.linalg.cross(b, c))
    base = far[0] * far[1] * far[2]
    base = base + dot(a, b) * far[2] + dot(b, c) * far[0] + dot(c, a) * far[1]
    angle = 2 * torch.atan2(-volume, base)
    level = level - height * angle
    return level, first - normal * (height * level)[..., None], slope - normal * angle[..., None]
