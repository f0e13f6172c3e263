"""Electric field integral equation (EFIE) with RWG basis functions, for open and closed conductors.

Each basis function describes the current across a side of two triangles and is linear on both;
where more triangles share a side, the first one has a function with each of the others. Galerkin
testing gives a symmetric matrix, so that fields are reciprocal. Integrals over distant triangles
use quadrature; near ones integrate 1/R in closed form.

At the interior resonances of a closed body the equation is singular. The condition that the field
at interior points vanishes is added as least squares.

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

_NEAR_RATIO = 1.6  # distance of near triangles over the sum of their radii
_MAX_DOUBLE_UNKNOWNS = 2500  # number of unknowns up to which double precision is used
_ENTRIES_AT_ONCE = 1 << 22
_PAIRS_AT_ONCE = 1 << 14
_ASPECTS_AT_ONCE = 32
_MIN_DISTANCE = 1e-12  # of 1/k: least distance of two points


def _symmetric_quadrature(*orbits: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """Barycentric coordinates and weights of points, from the distinct coordinate of each orbit."""
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
    """RWG (Rao-Wilton-Glisson) basis functions, one row each.

    Attributes:
        face: triangles that the current flows from and to.
        corner: corners of these triangles opposite to the common side.
    """

    face: Int64[Tensor, "unknown 2"]
    corner: Int64[Tensor, "unknown 2"]


def build_rwg_basis(faces: Int64[np.ndarray, "face 3"]) -> RWGBasis:
    """Build all RWG basis functions of a conforming mesh.

    Args:
        faces: vertex numbers of the triangles.
    """
    ends = np.sort(np.stack([np.roll(faces, -1, 1), np.roll(faces, -2, 1)], 2).reshape(-1, 2), 1)
    order = np.lexsort(ends.T)
    new = np.ones(len(order), dtype=bool)
    new[1:] = (ends[order[1:]] != ends[order[:-1]]).any(1)
    first = order[np.flatnonzero(new)[new.cumsum() - 1]]
    pairs = torch.from_numpy(np.stack([first, order], 1)[~new])
    return RWGBasis(pairs // 3, pairs % 3)


class EFIEMatrix:
    """EFIE impedance matrix of a mesh at one frequency.

    Args:
        faces: vertex numbers of the triangles.
        basis: RWG basis functions.
        wave_number: wave number k [1/m].
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
        """Compute the excitation ∫ f·E exp(jk u·x) of all basis functions f.

        Args:
            vertices: vertex positions [m].
            directions: unit vectors u to the antennas.
            fields: fields E of the waves [V/m].
        """
        corners = vertices[self.faces]
        shares, weights = QUADRATURE_7
        centroid = corners.mean(1)
        offset = shares @ (corners - centroid[:, None])
        wave = phasor(self.k * ((offset + centroid[:, None]) @ directions.T)) * weights[:, None] / 2
        linear = torch.einsum("fqa,fqx,atx->fat", wave, offset + 0j, fields + 0j)
        corner_fields = torch.einsum("fvx,atx->fvat", corners - centroid[:, None], fields)
        return self._combine_halves(linear[:, None] - wave.sum(1)[:, None, :, None] * corner_fields)

    def _combine_halves(self, local: Tensor) -> Tensor:
        """Combine half functions, given per triangle and corner, to basis functions."""
        face, corner = self.basis.face, self.basis.corner
        return local[face[:, 0], corner[:, 0]] - local[face[:, 1], corner[:, 1]]

    def half_coefficients(
        self, current: Complex[Tensor, "unknown *column"]
    ) -> Complex[Tensor, "face 3 *column"]:
        """Coefficients of half functions per triangle and corner.

        Args:
            current: coefficients of the basis functions.
        """
        face, corner = self.basis.face, self.basis.corner
        found = torch.zeros(3 * len(self.faces), *current.shape[1:], dtype=current.dtype)
        for half, sign in ((0, 1.0), (1, -1.0)):
            found.index_add_(0, 3 * face[:, half] + corner[:, half], sign * current)
        return found.view(len(self.faces), 3, *current.shape[1:])

    def near_pairs(self, vertices: Float64[Tensor, "v 3"]) -> Int64[Tensor, "pair 2"]:
        """Find pairs of near triangles, each with itself included.

        Args:
            vertices: vertex positions [m].
        """
        corners = vertices[self.faces]
        centroid = corners.mean(1)
        radius = (corners - centroid[:, None]).norm(dim=2).amax(1)
        tree = KDTree(centroid.numpy())
        pairs = tree.query_pairs(2 * _NEAR_RATIO * float(radius.max()), output_type="ndarray")
        pairs = torch.from_numpy(pairs.astype(np.int64))
        distance = (centroid[pairs[:, 0]] - centroid[pairs[:, 1]]).norm(dim=1)
        pairs = pairs[distance < _NEAR_RATIO * radius[pairs].sum(1)]
        self_pairs = torch.arange(len(self.faces))[:, None].expand(-1, 2)
        pairs = torch.cat([self_pairs, pairs, pairs.flip(1)])
        return pairs[(pairs[:, 0] * len(self.faces) + pairs[:, 1]).argsort()]

    def assemble(self, vertices: Float64[Tensor, "v 3"]) -> Complex[Tensor, "unknown unknown"]:
        """Assemble Z: jk ∫∫ (f·f′ − ∇·f ∇·f′/k²) G of all basis functions.

        Args:
            vertices: vertex positions, detached [m].
        """
        pairs = self.near_pairs(vertices)
        total = self._far_interactions(vertices, pairs)
        face, corner = self.basis.face.numpy(), self.basis.corner.numpy()
        numbers = np.arange(self.count)
        row = np.concatenate([numbers, numbers])
        half_number = (3 * face + corner).T.ravel()
        sign = np.repeat([1.0, -1.0], self.count)
        halves = csr_array((sign, (row, half_number)), shape=(self.count, 3 * len(self.faces)))
        blocks = pairs.split(_PAIRS_AT_ONCE)
        parts = torch.cat([self._near_interactions(vertices, block) for block in blocks]).numpy()
        half_numbers = 3 * pairs.numpy()[:, :, None] + np.arange(3)
        rows = np.broadcast_to(half_numbers[:, 0, :, None], parts.shape).ravel()
        columns = np.broadcast_to(half_numbers[:, 1, None, :], parts.shape).ravel()
        local = coo_array((parts.ravel(), (rows, columns)), shape=(3 * len(self.faces),) * 2)
        close = (halves @ local.tocsr() @ halves.T).tocoo()
        close.sum_duplicates()
        entry = torch.from_numpy(close.row.astype(np.int64) * self.count + close.col)
        total.view(-1)[entry] += torch.from_numpy(close.data / 2).to(total.dtype)
        # Each pair is stored above or below the diagonal, or half in both.
        size = max(1, _ENTRIES_AT_ONCE // self.count)
        for begin in range(0, self.count, size):
            block = slice(begin, begin + size)
            symmetric = total[block, begin:] + total[begin:, block].mT
            total[block, begin:] = symmetric
            total[begin:, block] = symmetric.mT
        return total.mul_(1j * self.k)

    def _far_interactions(self, vertices: Tensor, pairs: Tensor) -> Tensor:
        """Z/jk of distant triangles, one order of each pair."""
        count = len(self.faces)
        points, products = self._quadrature_points(vertices)
        points = points.to(self.real_dtype).reshape(-1, 3)

        face, corner = self.basis.face.numpy(), self.basis.corner.numpy()
        shape = (self.count, 3 * count)
        row = np.tile(np.repeat(np.arange(self.count), 3), 2)
        indices = row, (3 * face.T[..., None] + np.arange(3)).ravel()
        parts = []
        for part in products.numpy().transpose(3, 0, 1, 2).astype(points.numpy().dtype):
            first, second = part[face.T, corner.T]
            parts.append(csr_array((np.stack([first, -second]).ravel(), indices), shape=shape))
        scale = [1.0, 1.0, 1.0, -1 / self.k**2]
        total = torch.zeros(self.count, self.count, dtype=self.complex_dtype)
        bounds = torch.searchsorted(pairs[:, 0].contiguous(), torch.arange(count + 1))
        size = max(1, _ENTRIES_AT_ONCE // (9 * count))
        for begin in range(0, count, size):
            end = min(begin + size, count)
            excluded = pairs[bounds[begin] : bounds[end]]
            excluded = excluded[excluded[:, 1] >= begin]
            kernel = self._greens_function(points[3 * begin :], points[3 * begin : 3 * end])
            kernel[:, : 3 * (end - begin)] /= 2
            blocked = kernel.view(2, count - begin, 3, end - begin, 3)
            blocked[:, excluded[:, 1] - begin, :, excluded[:, 0] - begin] = 0
            flat = kernel.permute(1, 0, 2).reshape(len(points) - 3 * begin, -1).numpy()
            rows = np.flatnonzero(((face >= begin) & (face < end)).any(1))
            found = torch.zeros(2 * self.count, len(rows), dtype=self.real_dtype)
            for part, weight in zip(parts, scale, strict=True):
                radiated = torch.from_numpy(part[:, 3 * begin :] @ flat)
                tested = part[rows, 3 * begin : 3 * end].toarray()
                radiated = radiated.view(2 * self.count, -1)
                found.addmm_(radiated, torch.from_numpy(tested).T, alpha=weight)
            pair = found.view(self.count, 2, len(rows)).permute(2, 0, 1).contiguous()
            total[torch.from_numpy(rows)] += torch.view_as_complex(pair)
        return total

    def _quadrature_points(self, vertices: Tensor) -> tuple[Tensor, Tensor]:
        """Three quadrature points per triangle, with ∫ f and ∫ ∇·f of the half functions there.

        Returns:
            Points [face, point, 3], and products [face, corner, point, (x, y, z, divergence)].
        """
        corners = vertices[self.faces]
        centroid = corners.mean(1)
        shares, weights = QUADRATURE_3
        offset = shares @ (corners - centroid[:, None])
        linear = offset[:, None] - (corners - centroid[:, None])[:, :, None]
        products = torch.cat([linear / 2, torch.ones_like(linear[..., :1])], -1) * weights[:, None]
        return offset + (centroid - vertices.detach().mean(0))[:, None], products

    def _greens_function(self, points: Tensor, others: Tensor) -> Tensor:
        """Real and imaginary part of the Green's function between points: [2, point, other]."""
        square = torch.zeros(len(points), len(others), dtype=points.dtype)
        for axis in range(3):
            square = square + (points[:, None, axis] - others[:, axis]).square()
        distance = (square + (_MIN_DISTANCE / self.k) ** 2).sqrt()
        phase, amplitude = self.k * distance, 1 / (4 * math.pi * distance)
        return torch.stack([phase.cos() * amplitude, -phase.sin() * amplitude])

    def _near_interactions(self, vertices: Tensor, pairs: Tensor) -> Tensor:
        """Z/jk of half functions on pairs of near triangles: [pair, 3, 3].

        The 1/R of the source triangle is integrated in closed form; the remainder of G is smooth.
        """
        test, source = (vertices[self.faces[pairs[:, side]]] for side in (0, 1))
        centre, middle = test.mean(1), source.mean(1)
        shares, weights = QUADRATURE_7
        point = shares @ test
        constant, linear, _ = self._triangle_fields(source, point)
        along = (point - centre[:, None])[:, None] - (test - centre[:, None])[:, :, None]
        along = along * (weights / 4)[:, None]
        offset = (source - middle[:, None]) + 0j
        inner = linear[:, :, None] - constant[..., None, None] * offset[:, None]
        found = torch.einsum("piqx,pqjx->pij", along + 0j, inner)
        return found - ((weights * constant).sum(1) / self.k**2)[:, None, None]

    def _triangle_fields(
        self, corners: Tensor, points: Tensor, *, gradient: bool = False
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Potentials of constant and linear currents on triangles, over their area.

        Linear currents are x minus the centroid.

        1/R is integrated in closed form; the remainder of exp(−jkR)/R is smooth.

        Returns:
            Potentials [triangle, point] and [triangle, point, 3], and the gradient of the first, if
            requested.
        """
        centroid = corners.mean(1)[:, None]
        shares, weights = QUADRATURE_7
        nodes = shares @ corners
        level, first, slope = triangle_potentials(corners, points)
        double = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        scale = 1 / (2 * math.pi * double.norm(dim=1))[:, None]
        offset = points[:, :, None] - nodes[:, None]
        distance = (dot(offset, offset) + (_MIN_DISTANCE / self.k) ** 2).sqrt()
        phase = self.k * distance
        # exp(−jkR) − 1 without cancellation.
        rest = torch.complex(-2 * (phase / 2).sin().square(), -phase.sin())
        smooth = rest / (4 * math.pi * distance) * weights
        constant = level * scale + smooth.sum(2)
        linear = (first + (points - centroid) * level[..., None]) * scale[..., None]
        linear = linear + torch.einsum("pqr,prx->pqx", smooth, (nodes - centroid) + 0j)
        if not gradient:
            return constant, linear, None
        decay = -(1j * phase * phasor(-phase) + rest) / (4 * math.pi * distance**3) * weights
        return (constant, linear, slope * scale[..., None] + (decay[..., None] * offset).sum(2))

    def bilinear(
        self,
        vertices: Float64[Tensor, "v 3"],
        left: Complex128[Tensor, "unknown aspect p"],
        right: Complex128[Tensor, "unknown aspect q"],
    ) -> Complex128[Tensor, "aspect p q"]:
        """Compute Lᵀ Z R of each aspect's currents, with derivatives, block by block.

        Args:
            vertices: vertex positions [m].
            left, right: coefficients L and R of the basis functions.
        """
        pairs = self.near_pairs(vertices.detach())
        ends = (self.half_coefficients(left), self.half_coefficients(right))
        parts = [
            self._bilinear_block(vertices, pairs, *(end[:, :, some] for end in ends))
            for some in torch.arange(left.shape[1]).split(_ASPECTS_AT_ONCE)
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
        # The factor j/k of the divergence, squared, is −1/k².
        halves = (
            torch.einsum("fcqz,fcap->fqapz", products * scale, half) for half in (left, right)
        )
        strengths = [half.flatten(0, 1).to(self.complex_dtype) for half in halves]
        bounds = torch.searchsorted(pairs[:, 0].contiguous(), torch.arange(count + 1))
        size = max(1, _ENTRIES_AT_ONCE // (9 * count))

        def far_block(
            points: Tensor, left_strengths: Tensor, right_strengths: Tensor, begin: int
        ) -> Tensor:
            end = min(begin + size, count)
            excluded = pairs[bounds[begin] : bounds[end]]
            mask = torch.ones(end - begin, count, dtype=points.dtype)
            mask[excluded[:, 0] - begin, excluded[:, 1]] = 0
            mask = mask.repeat_interleave(3, 0).repeat_interleave(3, 1)
            kernel = self._greens_function(points[3 * begin : 3 * end], points) * mask
            kernel = torch.complex(kernel[0], kernel[1])
            field = kernel @ right_strengths.flatten(1)
            field = field.view(len(kernel), *right_strengths.shape[1:])
            block = left_strengths[3 * begin : 3 * end]
            return torch.einsum("eapz,eaqz->apq", block, field).to(torch.complex128)

        def near_block(vertices: Tensor, block: Tensor) -> Tensor:
            local = self._near_interactions(vertices, block) / 2
            test, source = block.unbind(1)
            # Mean of both orders, as in the matrix.
            field = torch.einsum("nij,njaq->niaq", local, right[source])
            reciprocal = torch.einsum("nij,niaq->njaq", local, right[test])
            found = torch.einsum("niap,niaq->apq", left[test], field)
            return found + torch.einsum("njap,njaq->apq", left[source], reciprocal)

        total = torch.zeros(*left.shape[2:], right.shape[-1], dtype=torch.complex128)
        for begin in range(0, count, size):
            total = total + checkpoint(far_block, points, *strengths, begin, use_reentrant=False)
        for block in pairs.split(_PAIRS_AT_ONCE):
            total = total + checkpoint(near_block, vertices, block, use_reentrant=False)
        return total

    def sample_currents(
        self, vertices: Float64[Tensor, "v 3"], current: Complex128[Tensor, "unknown column"]
    ) -> tuple[Float64[Tensor, "point 3"], Complex128[Tensor, "point column 3"]]:
        """Sample currents: points [m], and J dA there.

        Args:
            vertices: vertex positions [m].
            current: coefficients of the basis functions.
        """
        points, products = self._quadrature_points(vertices)
        halves = self.half_coefficients(current)
        moments = torch.einsum("fiqx,fic->fqcx", products[..., :3] + 0j, halves)
        return points.flatten(0, 1) + vertices.detach().mean(0), moments.flatten(0, 1)

    def interior_field_matrix(
        self, vertices: Float64[Tensor, "v 3"], interior_points: Float64[Tensor, "place 3"]
    ) -> Complex128[Tensor, "row unknown"]:
        """Matrix from currents to the incident field that they cancel at interior points.

        Args:
            vertices: vertex positions [m].
            interior_points: points off the surface [m].

        Returns:
            Rows are x, y and z of each point.
        """
        corners = vertices[self.faces]
        offset = corners - corners.mean(1)[:, None]

        def evaluate_chunk(chunk: Tensor) -> Tensor:
            points = chunk.expand(len(corners), -1, 3)
            constant, linear, charge = self._triangle_fields(corners, points, gradient=True)
            assert charge is not None
            part = linear[:, None] - constant[:, None, :, None] * offset[:, :, None]
            return self._combine_halves(0.5j * self.k * part + 1j / self.k * charge[:, None])

        chunks = interior_points.split(max(1, (_ENTRIES_AT_ONCE >> 6) // len(corners)))
        found = [checkpoint(evaluate_chunk, chunk, use_reentrant=False) for chunk in chunks]
        return torch.cat(found, 1).flatten(1).T


def triangle_potentials(
    corners: Float64[Tensor, "row 3 3"], points: Float64[Tensor, "row point 3"]
) -> tuple[
    Float64[Tensor, "row point"], Float64[Tensor, "row point 3"], Float64[Tensor, "row point 3"]
]:
    """Integrate 1/R over triangles in closed form.

    Args:
        corners: corners of the triangles [m].
        points: points x, on no side of a triangle [m].

    Returns:
        ∫ 1/R dy, ∫ (y − x)/R dy, and the gradient of the first with respect to x.

    Source: Wilton et al. 1984, with the logarithm as ln((R⁺ + R⁻ + L)/(R⁺ + R⁻ − L)), and the sum
    of arcs as the solid angle of Van Oosterom and Strackee.
    """
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = (normal / normal.norm(dim=1, keepdim=True))[:, None]
    offset = [corners[:, None, v] - points for v in range(3)]
    distances = [vector.norm(dim=-1) for vector in offset]
    height = -dot(offset[0], normal)
    level = torch.zeros_like(height)
    first = torch.zeros_like(points)
    slope = torch.zeros_like(points)
    for v in range(3):
        w = (v + 1) % 3
        side = (corners[:, w] - corners[:, v])[:, None]
        length = side.norm(dim=-1)
        tangent = side / length[..., None]
        outwards = cross(tangent, normal)
        distance = dot(offset[v], outwards)
        total = distances[v] + distances[w]
        logarithm = ((total + length) / (total - length)).log()
        level = level + distance * logarithm
        slope = slope - outwards * logarithm[..., None]
        square = distance.square() + height.square()
        ends = dot(offset[w], tangent) * distances[w] - dot(offset[v], tangent) * distances[v]
        first = first + outwards * ((square * logarithm + ends) / 2)[..., None]
    a, b, c = offset
    volume = dot(a, torch.linalg.cross(b, c))
    base = distances[0] * distances[1] * distances[2]
    base = base + dot(a, b) * distances[2] + dot(b, c) * distances[0] + dot(c, a) * distances[1]
    angle = 2 * torch.atan2(-volume, base)
    level = level - height * angle
    return (level, first - normal * (height * level)[..., None], slope - normal * angle[..., None])
