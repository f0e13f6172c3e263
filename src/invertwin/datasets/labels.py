"""Labels of a recording: classes, boxes, poses and visible triangles of objects."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from invertwin.channel import visible_points
from invertwin.constants import OLD_AXES
from invertwin.radar.radar import Radar
from invertwin.scene import Mesh, Scene
from invertwin.scene.mesh import concatenate_meshes

_VECTORS = ("low", "high", "center", "size", "velocity", "positions", "joint")
_MATRICES = ("pose", "rotation", "rotations")
_POINTS = 256  # at least so many on every object
_R2_STEPS = torch.tensor([0.7548776662466927, 0.5698402909980532], dtype=torch.float64)


def object_labels(
    scene: Scene,
    visibility: Mapping[str, Float[Tensor, "frame face"]],
    classes: Mapping[str, str],
    joints: Mapping[str, Mapping[str, Tensor]],
) -> list[dict[str, Any]]:
    """Labels of every object for JSON, in the order of the scene; world frame, SI units.

    A row has ``name``, ``class``, ``pose`` (4 × 4, from the object's frame to the world), ``box``
    (``low`` and ``high`` corner along the world's axes), ``oriented_box`` (``center``, ``size`` and
    ``rotation``: along the object's own axes, the columns of ``rotation``), ``velocity`` (the mean
    over its vertices), ``triangles`` (number of the first one in the scene, and how many),
    ``visibility`` (share of the surface that each position of the radar sees), and ``joints`` where
    it has some.

    Args:
        scene: Scene at the time of the recording.
        visibility: Result of ``triangle_visibility``.
        classes: Classes by name; an object without one is a class of its own name.
        joints: Places of joints in the world [m], by object and name.
    """
    rows, first = [], 0
    for name, item in scene.objects.items():
        corners, own = item.vertices, item.mesh.vertices
        low, high = own.amin(0), own.amax(0)
        still = torch.zeros(1, 3, dtype=torch.float64)
        velocity = still if item.velocity is None else item.velocity.reshape(-1, 3)
        areas = item.mesh.triangle_areas.detach()
        found: dict[str, Any] = {
            "name": name,
            "class": classes.get(name, name),
            "pose": item.transform.tolist(),
            "box": {"low": corners.amin(0).tolist(), "high": corners.amax(0).tolist()},
            "oriented_box": {
                "center": item.center.tolist(),
                "size": (high - low).tolist(),
                "rotation": item.transform[:3, :3].tolist(),
            },
            "velocity": velocity.mean(0).tolist(),
            "triangles": {"first": first, "count": len(areas)},
            "seen": (visibility[name].double() @ (areas / areas.sum())).tolist(),
        }
        if name in joints:
            found["joints"] = {joint: place.tolist() for joint, place in joints[name].items()}
        rows.append(found)
        first += len(areas)
    return rows


def radar_labels(radar: Radar) -> dict[str, Any]:
    """Poses of the radar in every frame: ``positions`` [m] and ``rotations`` in the world.

    The columns of a rotation are the radar's axes: boresight, left, up.
    """
    return {"positions": radar.positions.tolist(), "rotations": radar.link().rotations.tolist()}


def convert_old_labels(labels: Any, name: str = "") -> Any:
    """Labels with x forward, y left, z up, from those with x left, y up, z ahead.

    Objects' own axes turn with those of the world, those of mesh files too: vectors become P p,
    rotations P R Pᵀ.

    Args:
        labels: labels of a sample, or a part of them.
        name: key of the part.
    """
    if isinstance(labels, dict):
        return {
            key: convert_old_labels(item, "joint" if name == "joints" else key)
            for key, item in labels.items()
        }
    if name in _MATRICES:
        order = [*OLD_AXES, 3][: np.shape(labels)[-1]]  # the 1 of poses stays last
        return np.array(labels)[..., order, :][..., order].tolist()
    if name in _VECTORS:
        return np.array(labels)[..., OLD_AXES].tolist()
    return [convert_old_labels(item) for item in labels] if name == "objects" else labels


def triangle_visibility(scene: Scene, radar: Radar) -> dict[str, Float[Tensor, "frame face"]]:
    """Share of every triangle that each position of the radar sees, by object.

    Whatever lies between hides it, sheets too. Counted are points that are spread evenly over a
    triangle, so that an object has 256 or more: the share of an object's surface is right to some
    1/√256 at worst, of flat and large ones better.

    Args:
        scene: Surfaces in the world.
        radar: Its positions, one a frame; antennas are not distinguished.
    """
    meshes = [item.world_mesh for item in scene.objects.values()]
    points = [_sample_triangles(mesh) for mesh in meshes]
    flat, whole = torch.cat([part.reshape(-1, 3) for part in points]), concatenate_meshes(meshes)
    frames = [visible_points(whole, flat, place[None]) for place in radar.positions.detach()]
    parts = torch.stack(frames).split([part.shape[0] * part.shape[1] for part in points], dim=1)
    return {
        name: part.reshape(len(frames), *own.shape[:2]).float().mean(2)
        for name, part, own in zip(scene.names, parts, points, strict=True)
    }


def _sample_triangles(mesh: Mesh) -> Float64[Tensor, "face point 3"]:
    """Points in every triangle, the same shares of its sides in each.

    Source: M. Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018 (R₂).
    """
    numbers = torch.arange(1, math.ceil(_POINTS / len(mesh.faces)) + 1, dtype=torch.float64)
    u, v = ((0.5 + numbers[:, None] * _R2_STEPS) % 1.0).unbind(1)
    over = u + v > 1
    u, v = torch.where(over, 1 - u, u), torch.where(over, 1 - v, v)
    shares = torch.stack([1 - u - v, u, v], dim=1)
    return torch.einsum("pk,fkx->fpx", shares, mesh.vertices[mesh.faces])
