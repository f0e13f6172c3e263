"""Scenes: named objects, each a mesh with a material, a pose and a motion."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.checks import check_choice, checked_number, checked_tensor
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError, PhysicsWarning
from invertwin.limits import MAX_LENGTH
from invertwin.scene import pose as poses
from invertwin.scene.cloud import Cloud
from invertwin.scene.material.roughness import ROUGH_LOBE_WIDTH, lobe_exponent
from invertwin.scene.material.surface import Material
from invertwin.scene.mesh import Mesh


@dataclass(frozen=True, eq=False)
class Object:
    """Mesh with a material, at a pose in the world.

    Attributes:
        mesh: shape in the object's own frame.
        material: electromagnetic material of the surface.
        pose: rigid transform from the object's frame to the world; None is the identity.
        velocity: world velocity [m/s] of the whole object [3] or of each vertex [v, 3]; None =
            static.
        cloud: density for power paths, in the object's frame, in place of the mesh, which then only
            defines the position: poses rotate about its centre.

    Raises:
        InputError: wrong types or shapes, NaN, or a pose that is not rigid.
    """

    mesh: Mesh
    material: Material
    pose: Float64[Tensor, "4 4"] | None = None
    velocity: Float64[Tensor, "3"] | Float64[Tensor, "v 3"] | None = None
    cloud: Cloud | None = None

    def __post_init__(self) -> None:
        for value, kind, what, do in (
            (self.mesh, Mesh, "Mesh", "build one with Mesh(vertices, faces) or load_mesh(path)"),
            (self.material, Material, "Material", "give one such as RoughDielectric(permittivity)"),
            (self.cloud, Cloud | None, "Cloud or None", "build one with Cloud(low, high, density)"),
        ):
            if not isinstance(value, kind):
                raise InputError(f"expected a {what}, got {type(value).__name__}; {do}")
        faces = self.material.faces
        if faces is not None and faces != len(self.mesh.faces):
            raise InputError(
                f"expected material values for the mesh's {len(self.mesh.faces)} triangles, "
                f"got {faces}; give one number per triangle, or one for all"
            )
        if self.pose is not None:
            object.__setattr__(self, "pose", _checked_pose(self.pose))
        if self.velocity is not None:
            count = len(self.mesh.vertices)
            do = f"give one vector [3] or one per vertex [{count}, 3]"
            shape = (count, 3) if getattr(self.velocity, "ndim", 1) == 2 else (3,)
            velocity = checked_tensor(self.velocity, shape, "velocity [m/s]", do, SPEED_OF_LIGHT)
            object.__setattr__(self, "velocity", velocity)

    @property
    def transform(self) -> Float64[Tensor, "4 4"]:
        """Pose as a matrix, also if it is None."""
        return torch.eye(4, dtype=torch.float64) if self.pose is None else self.pose

    @property
    def vertices(self) -> Float64[Tensor, "v 3"]:
        """Vertex positions in the world [m], with the gradients of the mesh and the pose."""
        points = self.mesh.vertices
        return points if self.pose is None else _transform_points(points, self.pose)

    @property
    def world_mesh(self) -> Mesh:
        """Mesh in world axes, without derivatives."""
        return Mesh(self.vertices.detach(), self.mesh.faces)

    @property
    def center(self) -> Float64[Tensor, "3"]:
        """World position [m] of the centre of the mesh's bounding box in the object's frame.

        Rotations and scalings act about it. Differentiable like `vertices`.
        """
        center = self.mesh.center
        return center if self.pose is None else _transform_points(center[None], self.pose)[0]

    def advance(self, time: float) -> "Object":
        """Return the object displaced by its velocity for `time` [s], at rest."""
        checked_number(time, "time [s]", -torch.inf)
        if self.velocity is None:
            return self
        if self.velocity.ndim == 1:
            motion = poses.rigid(translation=self.velocity * time)
            return replace(self, pose=poses.compose(self.transform, motion), velocity=None)
        # Velocities are world vectors; row vectors times R are in the object's frame.
        offsets = self.velocity * time @ self.transform[:3, :3]
        mesh = Mesh(self.mesh.vertices + offsets, self.mesh.faces)
        return replace(self, mesh=mesh, velocity=None)

    def change_basis(self, basis: poses.Basis) -> "Object":
        """Return the object along other axes, those of its own frame included."""
        return replace(
            self,
            mesh=self.mesh.change_basis(basis),
            pose=None if self.pose is None else basis.poses(self.pose),
            velocity=None if self.velocity is None else basis.vectors(self.velocity),
            cloud=None if self.cloud is None else self.cloud.change_basis(basis),
        )


def transform_vertices(objects: Sequence[Object]) -> list[Float64[Tensor, "v 3"]]:
    """Return the ``vertices`` of many objects; objects with equal vertex counts are batched.

    Args:
        objects: any number of objects.
    """
    found: dict[int, Tensor] = {}
    alike: dict[int, list[int]] = {}
    for number, item in enumerate(objects):
        if item.pose is None:
            found[number] = item.mesh.vertices
        else:
            alike.setdefault(len(item.mesh.vertices), []).append(number)
    for numbers in alike.values():
        points = torch.stack([objects[n].mesh.vertices for n in numbers])
        moved = _transform_points(points, torch.stack([objects[n].transform for n in numbers]))
        found |= zip(numbers, moved.unbind(), strict=True)
    return [found[number] for number in range(len(objects))]


def _transform_points(points: Float64[Tensor, "*n v 3"], pose: Float64[Tensor, "*n 4 4"]) -> Tensor:
    return points @ pose[..., :3, :3].mT + pose[..., None, :3, 3]


@dataclass(frozen=True, eq=False)
class Scene:
    """Frozen collection of objects by name.

    Attributes:
        objects: objects in their order (a read-only mapping).

    Raises:
        InputError: no objects, an empty name, or a value that is not an Object.
    """

    objects: Mapping[str, Object]

    def __post_init__(self) -> None:
        if not isinstance(self.objects, Mapping) or not self.objects:
            got = "none" if isinstance(self.objects, Mapping) else type(self.objects).__name__
            raise InputError(
                f"expected at least one named object, got {got}; give a dict of name: Object(...)"
            )
        for name, value in self.objects.items():
            if not isinstance(name, str) or not name.strip() or not name.isprintable():
                raise InputError(
                    "expected object names that are not empty and have no control characters, got "
                    f"{name!r}; name every object"
                )
            if not isinstance(value, Object):
                raise InputError(
                    f"expected an Object for {name!r}, got {type(value).__name__}; "
                    "give Object(mesh, material)"
                )
        object.__setattr__(self, "objects", MappingProxyType(dict(self.objects)))

    def __reduce__(self) -> tuple[Any, ...]:
        # A read-only mapping view can be neither copied nor pickled.
        return type(self), (dict(self.objects),)

    def __getitem__(self, name: str) -> Object:
        """Return the object of a name.

        Raises:
            InputError: no object of that name.
        """
        check_choice(name, self.objects, "the name of an object in the scene:", "use one of these")
        return self.objects[name]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objects in order."""
        return tuple(self.objects)

    def replace(self, name: str, **changes: Any) -> "Scene":
        """Return a scene with some fields of one object replaced.

        Args:
            name: name of the object.
            changes: new values of `mesh`, `material`, `pose`, `velocity` or `cloud`.

        Raises:
            InputError: no such object or field; the mesh or material of a cloud, which do nothing.
        """
        for key in changes:
            check_choice(key, Object.__dataclass_fields__, "changes of", "use one of these")
        changed = replace(self[name], **changes)
        shaped = [field for field in ("mesh", "material") if field in changes]
        if shaped and changed.cloud is not None:
            raise InputError(
                f"expected changes of pose or density of the cloud {name!r}, got its {shaped[0]}, "
                "which rays do not see; fit its density alone, or take the cloud away"
            )
        return Scene({**self.objects, name: changed})

    def advance(self, time: float) -> "Scene":
        """Return the scene with all objects displaced by their velocities for `time` [s]."""
        return Scene({name: value.advance(time) for name, value in self.objects.items()})

    def change_basis(self, basis: poses.Basis) -> "Scene":
        """Return the scene along other axes."""
        moved = {name: value.change_basis(basis) for name, value in self.objects.items()}
        return replace(self, objects=moved)

    def to_frame(self, frame: poses.FrameName) -> "Scene":
        """Return the scene in the frame of another program, see `invertwin.scene.to_frame`."""
        return poses.to_frame(self, frame)

    def from_frame(self, frame: poses.FrameName) -> "Scene":
        """Return the scene in our frame, given in that of another program."""
        return poses.from_frame(self, frame)


def warn_if_purely_specular(scene: Scene, frequency: float) -> None:
    """Warn if no surface scatters: a radar receives specular reflections at normal incidence only.

    Scenes of perfect conductors and clouds alone cause no warning.

    Args:
        scene: observed scene.
        frequency: carrier frequency [Hz].
    """
    bodies = [item for item in scene.objects.values() if item.cloud is None]
    rough = [item for item in bodies if not item.material.coherent]
    with torch.no_grad():
        if rough and not any(_has_diffuse_scattering(item.material, frequency) for item in rough):
            kinds = ", ".join(sorted({type(item.material).__name__ for item in rough}))
            warnings.warn(
                f"no surface scatters ({kinds}): all are mirrors, which a radar sees only where "
                "they face it; give them scattering, or RoughDielectric a diffuse share",
                PhysicsWarning,
                stacklevel=3,
            )


def _has_diffuse_scattering(material: Material, frequency: float) -> bool:
    surface = material.scattering_law(frequency)
    wide = surface.exponents[..., 0] <= 1.01 * lobe_exponent(ROUGH_LOBE_WIDTH)
    return bool(((surface.diffuse > 0) | wide | (surface.lobes[..., 1:] > 0).any(dim=-1)).any())


def _checked_pose(pose: object) -> Tensor:
    do = "build one with rigid(rotation, translation)"
    matrix = checked_tensor(pose, (4, 4), "pose", do, MAX_LENGTH)
    fixed = matrix.detach()
    rotation, bottom = fixed[:3, :3], fixed[3]
    gram = rotation @ rotation.T - torch.eye(3, dtype=torch.float64)
    is_rigid = (
        gram.abs().max() < 1e-5
        and torch.linalg.det(rotation) > 0
        and bool(torch.equal(bottom, bottom.new_tensor([0.0, 0.0, 0.0, 1.0])))
    )
    if not is_rigid:
        raise InputError(
            "expected a rigid pose (rotation, translation, last row 0 0 0 1), "
            f"got {[[round(x, 4) for x in row] for row in fixed.tolist()]}; {do}, "
            "and scale the mesh instead"
        )
    return matrix


def displace(
    item: Object, offset: Float64[Tensor, "3"], rotation: Float64[Tensor, "3"] | None = None
) -> Object:
    """Return an object rotated about its centre and translated.

    Args:
        item: object to displace.
        offset: displacement of its centre [3] [m].
        rotation: rotation vector [3] [rad]; None = no rotation.
    """
    turn = poses.rotation_from_vector(torch.zeros_like(offset) if rotation is None else rotation)
    motion = poses.rigid(turn, offset + item.center - turn @ item.center)
    return replace(item, pose=motion @ item.transform)
