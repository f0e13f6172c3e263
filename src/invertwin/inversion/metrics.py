"""Errors of a reconstruction: pose, scale, surface distance, volume and topology."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import igl
import numpy as np
import torch
import trimesh
from jaxtyping import Float64
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from invertwin.channel import visible_points
from invertwin.checks import ArrayLike, checked_count, checked_number
from invertwin.errors import InputError
from invertwin.runtime.memory import require_at_most
from invertwin.scene import Itu, Material, Mesh, Object
from invertwin.scene.material.materials import select_layer
from invertwin.scene.material.values import Value, evaluate_value

SURFACE_POINT_COUNT = 20_000  # points on each surface
VOXEL_EDGE = 0.02  # [m]
_MAX_VOXELS = 200_000_000
_VOXELS_PER_CHUNK = 4_000_000  # voxels per chunk


@dataclass(frozen=True)
class ShapeMetrics:
    """Similarity of a reconstructed surface and the true one.

    Attributes:
        chamfer: mean of both directions of the distance to the closest point [m], not squared.
            Points are sampled at random, so equal surfaces of area A have ½ √(A / points).
        fscore: harmonic mean of precision and recall for each threshold [m]. Precision is the
            fraction of the reconstructed surface within the threshold of the true one; recall is
            the reverse.
        normal_consistency: mean of both directions of |n · n′| at closest points: 1 for equal
            surfaces, 0.5 for normals that are independent of each other.
        iou: volume of the intersection over that of the union; None if a mesh is not watertight, or
            if the volume was not computed.
    """

    chamfer: float
    fscore: dict[float, float]
    normal_consistency: float
    iou: float | None


@dataclass(frozen=True)
class TopologyCounts:
    """Numbers of components and holes of a closed surface.

    Attributes:
        components: connected components of the surface; the wall of a cavity is one too.
        euler_number: vertices − edges + triangles: 2 for every component, minus 2 for every hole
            through it.
    """

    components: int
    euler_number: int


@dataclass(frozen=True)
class PoseError:
    """Pose error of one object with respect to the truth.

    Attributes:
        offset: offset of its centre [m].
        rotation: remaining rotation vector in world axes [rad].
        scale: estimated size over the true one.
    """

    offset: Float64[Tensor, "3"]
    rotation: Float64[Tensor, "3"]
    scale: float

    @property
    def angle(self) -> float:
        """Angle of the rotation [rad]."""
        return float(self.rotation.norm())

    @property
    def distance(self) -> float:
        """Length of the offset [m]."""
        return float(self.offset.norm())


def pose_error(found: Object, truth: Object) -> PoseError | None:
    """Compute the similarity transform between two copies of an object.

    Least squares over the vertices (Umeyama), so it does not depend on how the pose is
    parameterised. Returns None for meshes with different triangles.

    Args:
        found, truth: estimated and true object.
    """
    same = found.vertices.shape == truth.vertices.shape
    if not same or not torch.equal(found.mesh.faces, truth.mesh.faces):
        return None
    a, b = found.vertices.detach(), truth.vertices.detach()
    a0, b0 = a - a.mean(0), b - b.mean(0)
    rotation = Rotation.align_vectors(a0.numpy(), b0.numpy())[0]
    scale = float((a0 * torch.from_numpy(rotation.apply(b0.numpy()))).sum() / b0.square().sum())
    offset = found.center.detach() - truth.center.detach()
    return PoseError(offset, torch.from_numpy(rotation.as_rotvec()), scale)


def axis_error(found: Object, truth: Object, axis: ArrayLike) -> tuple[float, float]:
    """Compute the distance of the origins of two poses [m] and the angle between one of their axes
    [rad].

    Args:
        found, truth: estimated and true object.
        axis: axis in the object's frame, of any non-zero length.

    Raises:
        InputError: an axis of length zero.
    """
    line = torch.as_tensor(axis, dtype=torch.float64)
    if line.shape != (3,) or not float(line.norm()) > 0:
        raise InputError(f"expected an axis of some length, got {axis}; give x, y, z")
    a, b = (item.transform.detach() for item in (found, truth))
    one, other = a[:3, :3] @ line, b[:3, :3] @ line
    # atan2 of sine and cosine: arccos does not resolve angles below 1e-8.
    angle = math.atan2(float(torch.linalg.cross(one, other).norm()), float(one @ other))
    return float((a[:3, 3] - b[:3, 3]).norm()), angle


def compare_shapes(
    found: Mesh,
    truth: Mesh,
    *,
    seen_from: ArrayLike | None = None,
    thresholds: Sequence[float] = (0.02,),
    count: int = SURFACE_POINT_COUNT,
    voxel: float | None = VOXEL_EDGE,
    seed: int = 0,
) -> ShapeMetrics:
    """Compare two meshes in one frame.

    With `seen_from`, only parts visible from some radar position count: on each surface the points
    not occluded by the mesh, compared with the whole other surface; in the volume the voxels whose
    closest surface point is visible.

    Args:
        found, truth: estimated and true mesh.
        seen_from: radar positions [n, 3] in the frame of the meshes [m]; None counts everything.
        thresholds: thresholds of the F-score [m].
        count: number of points sampled on each surface.
        voxel: edge of the voxels of the volume [m]; None omits the volume.
        seed: seed of the points.

    Raises:
        InputError: meshes without area, no visible points, or numbers that are not positive.
    """
    if not thresholds or any(not t > 0 for t in thresholds):
        raise InputError(f"expected thresholds > 0 [m], got {list(thresholds)}; give e.g. 0.02")
    clouds = [sample_surface(mesh, count, seed, k) for k, mesh in enumerate((found, truth))]
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
    within = {float(t): [float((d <= t).mean()) for d in distances] for t in thresholds}
    iou = None
    if voxel is not None and is_watertight(found) and is_watertight(truth):
        iou = _shared_volume(found, truth, voxel, None if seen_from is None else (clouds, masks))
    return ShapeMetrics(
        chamfer=float(np.mean([d.mean() for d in distances])),
        fscore={t: 2 * a * b / max(a + b, 1e-300) for t, (a, b) in within.items()},
        normal_consistency=float(np.mean(alignments)),
        iou=iou,
    )


def volume_iou(found: Mesh, truth: Mesh, voxel: float = VOXEL_EDGE) -> float:
    """Compute the volume of the intersection of two closed meshes over that of their union, in
    voxels.

    A voxel is inside if the mesh winds around its centre, so overlapping closed parts count once
    and cavities are empty.

    Args:
        found, truth: estimated and true mesh.
        voxel: edge of a voxel [m].

    Raises:
        InputError: a mesh that is not watertight, or voxels that are too many.
    """
    _check_watertight(found, "found mesh")
    _check_watertight(truth, "true mesh")
    return _shared_volume(found, truth, voxel, None)


def is_watertight(mesh: Mesh) -> bool:
    """Return whether every edge has two triangles that traverse it in opposite directions."""
    solid = _to_trimesh(mesh)
    return bool(solid.is_watertight and solid.is_winding_consistent)


def count_topology(mesh: Mesh) -> TopologyCounts:
    """Count components and holes of a closed surface whose triangles share vertices.

    Raises:
        InputError: a mesh that is not watertight.
    """
    _check_watertight(mesh, "mesh")
    solid = _to_trimesh(mesh)
    parts = trimesh.graph.connected_components(solid.edges_unique)
    return TopologyCounts(len(parts), int(solid.euler_number))


def material_errors(
    values: Sequence[str],
    found: Material,
    truth: Material,
    frequency: float,
    layer: int | None = None,
) -> dict[str, float]:
    """Compute relative errors of material values, as ``<name>_error``.

    Args:
        values: names of the values; those that one of the materials lacks are omitted.
        found, truth: estimated and true material.
        frequency: frequency at which values of the ITU table are compared [Hz].
        layer: layer of multilayers, from 0; None = values of the materials themselves.

    Raises:
        InputError: no such layer.
    """
    ends = [select_layer(end, layer, type(end).__name__) for end in (found, truth)]
    errors = {}
    for name in values:
        if all(hasattr(end, name) for end in ends):
            value, true = (_evaluate_value(getattr(end, name), name, frequency) for end in ends)
            errors[f"{name}_error"] = float((value - true).abs().mean() / true.abs().mean())
    return errors


def _evaluate_value(value: Value | Itu, name: str, frequency: float) -> Tensor:
    found = getattr(value, name)(frequency) if isinstance(value, Itu) else value
    return evaluate_value(found).detach()


def sample_surface(
    mesh: Mesh, count: int, seed: int, stream: int = 0
) -> tuple[Float64[Tensor, "n 3"], Float64[Tensor, "n 3"]]:
    """Sample points uniformly over a surface [m], with the unit normals of their triangles.

    Args:
        mesh: the surface.
        count: number of points.
        seed: seed of the points.
        stream: index of an independent stream of the seed.

    Raises:
        InputError: a surface without area.
    """
    solid = _to_trimesh(mesh)
    if not solid.area > 0:
        raise InputError("expected a surface with area, got none; check the mesh")
    number = checked_count(count, "points", 1)
    points, rows = trimesh.sample.sample_surface(solid, number, seed=[seed, stream])[:2]
    return torch.from_numpy(np.array(points)), torch.from_numpy(np.array(solid.face_normals[rows]))


def _check_watertight(mesh: Mesh, name: str) -> None:
    if not is_watertight(mesh):
        raise InputError(
            f"expected a watertight {name}, whose edges all have two triangles that run along them "
            "in opposite directions, got an open one; close it, or compare surfaces"
        )


def _shared_volume(
    found: Mesh,
    truth: Mesh,
    voxel: float,
    keep: tuple[list[tuple[Tensor, Tensor]], list[np.ndarray]] | None,
) -> float:
    edge = checked_number(voxel, "voxel [m]", 0.0, open_low=True)
    both = torch.cat([found.vertices, truth.vertices]).detach().numpy()
    # Voxel centres on a lattice of the frame, so that both meshes are voxelised equally.
    first = np.floor(both.min(0) / edge).astype(np.int64)
    shape = np.ceil(both.max(0) / edge).astype(np.int64) - first
    require_at_most(math.prod(map(int, shape)), _MAX_VOXELS, "voxels", "give a larger voxel")
    inside = [_mark_inside_voxels(mesh, first, shape, edge) for mesh in (found, truth)]
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


def _mark_inside_voxels(
    mesh: Mesh, first: np.ndarray, shape: np.ndarray, edge: float
) -> np.ndarray:
    """Return whether a closed mesh winds around the centres of voxels [x, y, z].

    Source: Barill et al. 2018, "Fast winding numbers for soups and clouds".
    """
    solid, size = _to_trimesh(mesh), tuple(map(int, shape))
    vertices, faces = np.array(solid.vertices), np.array(solid.faces)
    inside = np.zeros(size, dtype=bool)
    step = max(1, _VOXELS_PER_CHUNK // max(size[1] * size[2], 1))
    for start in range(0, size[0], step):
        part = inside[start : start + step]
        index = np.indices(part.shape).reshape(3, -1).T + np.array([start, 0, 0])
        winding = igl.fast_winding_number(vertices, faces, (index + first + 0.5) * edge)
        part[:] = (np.abs(winding) > 0.5).reshape(part.shape)
    return inside


def _to_trimesh(mesh: Mesh) -> trimesh.Trimesh:
    """Convert to trimesh, without degenerate triangles."""
    faces = mesh.faces.numpy()
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    return trimesh.Trimesh(mesh.vertices.detach().numpy(), faces, process=False)
