"""How close a shape is to another: distances, shared volume, normals, parts and holes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from invertwin.channel import visible_points
from invertwin.errors import InputError
from invertwin.scene.checks import ArrayLike, checked_count, checked_number
from invertwin.scene.mesh import Mesh

POINTS = 20_000  # of each surface
VOXEL = 0.02  # [m]
_MOST_VOXELS = 200_000_000


@dataclass(frozen=True)
class Likeness:
    """How close a found surface is to the true one.

    Attributes:
        chamfer: mean of both directions of the distance to the closest point [m], not squared.
            Points are drawn at random, so equal surfaces of area A are ½ √(A / points) apart.
        fscore: harmonic mean of the shares of either surface within a threshold of the other, by
            threshold [m].
        normal_consistency: mean of both directions of |n · n′| at closest points: 1 for equal
            surfaces, 0.5 for normals that know nothing of each other.
        iou: shared over joint volume; None where a mesh is not watertight, or it was left out.
    """

    chamfer: float
    fscore: dict[float, float]
    normal_consistency: float
    iou: float | None


@dataclass(frozen=True)
class Topology:
    """In how many parts a closed surface is, and with how many holes.

    Attributes:
        components: parts of the surface that nothing joins; a cavity's wall is one too.
        euler_number: vertices − edges + triangles: 2 for every part, less 2 for every hole through.
    """

    components: int
    euler_number: int


def compare_shapes(
    found: Mesh,
    truth: Mesh,
    *,
    seen_from: ArrayLike | None = None,
    thresholds: Sequence[float] = (0.02,),
    count: int = POINTS,
    voxel: float | None = VOXEL,
    seed: int = 0,
) -> Likeness:
    """Compare two meshes that stand in one frame.

    With `seen_from`, only what some radar position sees counts: of either surface the points that
    no part of the same mesh hides, measured against the whole of the other surface; and of the
    volume the voxels whose closest surface point is seen.

    Args:
        found: the result.
        truth: what it should be.
        seen_from: radar positions [n, 3] in the frame of the meshes (m); None counts everything.
        thresholds: of the F-score [m].
        count: points drawn on each surface.
        voxel: edge of the voxels for the volume [m]; None leaves the volume out.
        seed: of the points.

    Raises:
        InputError: meshes without area, nothing that is seen, or numbers that are not positive.
    """
    if not thresholds or any(not t > 0 for t in thresholds):
        raise InputError(f"expected thresholds > 0 [m], got {list(thresholds)}; give e.g. 0.02")
    clouds = [surface_points(mesh, count, seed, k) for k, mesh in enumerate((found, truth))]
    masks = [np.ones(count, dtype=bool)] * 2
    if seen_from is not None:
        masks = [
            visible_points(mesh, points, seen_from).numpy()
            for (points, _), mesh in zip(clouds, (found, truth), strict=True)
        ]
        for name, mask in zip(("found", "true"), masks, strict=True):
            if not mask.any():
                raise InputError(
                    f"expected a {name} surface that some position sees, got none of "
                    f"{count} points; check positions and frame"
                )
    trees = [KDTree(points.numpy()) for points, _ in clouds]
    distances, alignments = [], []
    for own, other in ((0, 1), (1, 0)):
        points, normals = (part.numpy()[masks[own]] for part in clouds[own])
        gap, nearest = trees[other].query(points)
        distances.append(np.asarray(gap))
        closest = clouds[other][1].numpy()[nearest]
        alignments.append(float(np.abs((normals * closest).sum(1)).mean()))
    share = {float(t): [float((d <= t).mean()) for d in distances] for t in thresholds}
    iou = None
    if voxel is not None and is_watertight(found) and is_watertight(truth):
        keep = None if seen_from is None else (clouds, masks)
        iou = _shared_volume(found, truth, voxel, keep)
    return Likeness(
        chamfer=float(np.mean([d.mean() for d in distances])),
        fscore={t: 2 * a * b / max(a + b, 1e-300) for t, (a, b) in share.items()},
        normal_consistency=float(np.mean(alignments)),
        iou=iou,
    )


def volume_iou(found: Mesh, truth: Mesh, voxel: float = VOXEL) -> float:
    """Shared over joint volume of two closed meshes, counted in voxels.

    A voxel is inside where its centre is: signed crossings of a line along z, so overlapping
    closed parts count once and holes are holes.

    Args:
        found: the result.
        truth: what it should be.
        voxel: edge [m].

    Raises:
        InputError: a mesh that is not watertight, or voxels that are too many.
    """
    for name, mesh in (("found", found), ("true", truth)):
        if not is_watertight(mesh):
            raise InputError(
                f"expected a watertight {name} mesh, whose edges all have two triangles that run "
                "along them in opposite directions, got an open one; close it, or compare surfaces"
            )
    return _shared_volume(found, truth, voxel, None)


def is_watertight(mesh: Mesh) -> bool:
    """Whether every edge is run along as often in one direction as in the other."""
    faces = mesh.faces
    ahead = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ahead = ahead[ahead[:, 0] != ahead[:, 1]]
    count = len(mesh.vertices)
    forth = (ahead[:, 0] * count + ahead[:, 1]).sort().values
    back = (ahead[:, 1] * count + ahead[:, 0]).sort().values
    return bool(torch.equal(forth, back))


def topology(mesh: Mesh) -> Topology:
    """Parts and holes of a closed surface, whose triangles meet in shared vertices.

    Raises:
        InputError: a mesh that is not watertight.
    """
    if not is_watertight(mesh):
        raise InputError(
            "expected a watertight mesh, whose edges all have two triangles that run along them in "
            "opposite directions, got an open one; close it"
        )
    faces = mesh.faces.numpy()
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]  # not those shrunk to an edge
    sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    used, ends = np.unique(sides, return_inverse=True)
    edges = np.unique(ends.reshape(-1, 2), axis=0)
    ones = np.ones(len(edges), dtype=np.int8)
    graph = coo_array((ones, (edges[:, 0], edges[:, 1])), shape=(len(used), len(used)))
    count = int(connected_components(graph, directed=False, return_labels=False))
    return Topology(count, len(used) - len(edges) + len(faces))


def surface_points(
    mesh: Mesh, count: int, seed: int, stream: int = 0
) -> tuple[Float64[Tensor, "n 3"], Float64[Tensor, "n 3"]]:
    """Points drawn evenly over a surface [m], and the unit normals of their triangles.

    Args:
        mesh: the surface.
        count: how many.
        seed: of the points.
        stream: of one seed, for points that are independent.

    Raises:
        InputError: a surface without area.
    """
    draw = np.random.default_rng([seed, stream])
    corners = mesh.vertices.detach()[mesh.faces].numpy()
    sides = corners[:, 1:] - corners[:, :1]
    normals = np.cross(sides[:, 0], sides[:, 1])
    size = np.linalg.norm(normals, axis=1)
    if not size.sum() > 0:
        raise InputError("expected a surface with area, got none; check the mesh")
    rows = draw.choice(len(size), checked_count(count, "points", 1), p=size / size.sum())
    a, b = draw.uniform(size=(2, count, 1))
    flip = a + b > 1  # the half of the parallelogram beyond the triangle, turned back into it
    a, b = np.where(flip, 1 - a, a), np.where(flip, 1 - b, b)
    points = corners[rows, 0] + a * sides[rows, 0] + b * sides[rows, 1]
    return torch.from_numpy(points), torch.from_numpy(normals[rows] / size[rows, None])


def _shared_volume(
    found: Mesh,
    truth: Mesh,
    voxel: float,
    keep: tuple[list[tuple[Tensor, Tensor]], list[np.ndarray]] | None,
) -> float:
    edge = checked_number(voxel, "voxel [m]", 0.0, open_low=True)
    both = torch.cat([found.vertices, truth.vertices]).detach().numpy()
    # Centres on a lattice of the frame, so that both meshes are cut alike wherever they are.
    first = np.floor(both.min(0) / edge).astype(np.int64)
    shape = np.ceil(both.max(0) / edge).astype(np.int64) - first
    if math.prod(map(int, shape)) > _MOST_VOXELS:
        raise InputError(
            f"expected at most {_MOST_VOXELS} voxels, got {' × '.join(map(str, shape))}; "
            "give a larger voxel"
        )
    inside = [_inside(mesh, first, shape, edge) for mesh in (found, truth)]
    joint, shared = inside[0] | inside[1], inside[0] & inside[1]
    if keep is not None:
        clouds, masks = keep
        tree = KDTree(np.concatenate([points.numpy() for points, _ in clouds]))
        index = np.argwhere(joint)
        _, nearest = tree.query((index + first + 0.5) * edge)
        rows = tuple(index[np.concatenate(masks)[nearest]].T)
        joint, shared = joint[rows], shared[rows]
    total = int(joint.sum())
    if not total:
        raise InputError("expected volumes that hold voxels, got none; give a smaller voxel")
    return float(shared.sum() / total)


def _inside(mesh: Mesh, first: np.ndarray, shape: np.ndarray, edge: float) -> np.ndarray:
    """Whether voxel centres are inside of a closed mesh: winding along z by signed crossings."""
    vertices = mesh.vertices.detach().numpy() / edge - first - 0.5  # in voxels, centres integer
    winding = np.zeros((int(shape[0]), int(shape[1]), int(shape[2]) + 1), dtype=np.int32)
    for face in mesh.faces.tolist():
        corners = vertices[face]
        low = np.maximum(np.ceil(corners[:, :2].min(0)), 0).astype(int)
        high = np.minimum(np.floor(corners[:, :2].max(0)), shape[:2] - 1).astype(int)
        if (low > high).any():
            continue
        x, y = np.meshgrid(
            np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1), indexing="ij"
        )
        sides = [_side(vertices, face[k], face[(k + 1) % 3], x, y) for k in range(3)]
        for sign, hit in ((1, [s > 0 for s, _ in sides]), (-1, [s < 0 for s, _ in sides])):
            column = hit[0] & hit[1] & hit[2]
            if not column.any():
                continue
            # Barycentric coordinates: side k lies across from corner k + 2.
            area = sum(np.abs(value[column]) for _, value in sides)
            height = sum(
                np.abs(sides[k][1][column]) * corners[(k + 2) % 3, 2] for k in range(3)
            ) / np.maximum(area, 1e-300)
            # Centres above the crossing are further inside or outside by one.
            above = np.clip(np.floor(height).astype(int) + 1, 0, int(shape[2]))
            np.add.at(winding, (x[column], y[column], above), -sign)
    return winding.cumsum(axis=2)[:, :, :-1] != 0


def _side(
    vertices: np.ndarray, start: int, end: int, x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """On which side of an edge's projection places lie (±1, never 0), and twice the area.

    Computed from the lower to the higher vertex number, so that both triangles of an edge agree to
    the last bit: a line that meets the edge crosses exactly one of two that continue each other.
    """
    forth = start < end
    a, b = (vertices[start], vertices[end]) if forth else (vertices[end], vertices[start])
    value = (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])
    side = np.where(value >= 0, 1, -1)
    return (side, value) if forth else (-side, -value)
