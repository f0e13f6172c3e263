"""A scene as flat tables of torch tensors with derivatives, from which all paths are computed."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Literal

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from invertwin.channel.paths import Link
from invertwin.channel.rays.topology import Topology, topology_of
from invertwin.checks import is_differentiated
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError, PhysicsWarning
from invertwin.scene import Material, ScatteringLaw
from invertwin.scene.scene import Object, Scene, transform_vertices

_WIDE_LOBE = 0.2  # radians: no mesh is too coarse for such lobes


def interpolate_values(corners: tuple[Tensor, Tensor, Tensor], b1: Tensor, b2: Tensor) -> Tensor:
    """Interpolate between the corners of triangles (Dr.Jit form: ``interpolate_position``).

    Args:
        corners: values at the three corners.
        b1, b2: barycentric coordinates of the second and the third corner.
    """
    c0, c1, c2 = corners
    b1, b2 = b1[:, None], b2[:, None]
    return c0 * (1 - b1 - b2) + c1 * b1 + c2 * b2


@dataclass(frozen=True)
class Geometry:
    """A scene as flat tables, still torch and differentiable.

    Attributes:
        vertices: World positions of all objects, concatenated [m].
        faces: Vertex indices of all triangles.
        face_object: Index of the object of each triangle.
        face_surface: Row of each triangle in the tables of surfaces.
        surfaces: Scattering laws, one row per material, or per triangle where its values differ.
        has_lobe: For each lobe, True if it has weight, or a derivative that could give it some.
        has_sheets: Whether something passes straight through any surface.
        has_refracting_bodies: Whether any surface is the interface of a refracting body.
        has_spread: Whether any specular lobe lacks what is mirrored.
        names: Names of the objects.
        coherent: Per object, whether its field paths have a deterministic phase.
        differentiated: Per object, whether derivatives flow through its place or its shape.
        shape_differentiated: Per object, whether they flow through its shape.
        topology: Tables that depend on the connectivity only.
        velocities: World velocities of the vertices [m/s]; None = all at rest.
        object_scene: Per object, the scene that it belongs to, where several stand apart (see
            ``rays.batching``); None = one scene.
    """

    vertices: Float64[Tensor, "v 3"]
    faces: Int64[Tensor, "f 3"]
    face_object: Int64[Tensor, " f"]
    face_surface: Int64[Tensor, " f"]
    surfaces: ScatteringLaw
    has_lobe: tuple[bool, ...]
    has_sheets: bool
    has_refracting_bodies: bool
    has_spread: bool
    names: tuple[str, ...]
    coherent: tuple[bool, ...]
    differentiated: tuple[bool, ...]
    shape_differentiated: tuple[bool, ...]
    topology: Topology
    velocities: Float64[Tensor, "v 3"] | None = None
    object_scene: Int64[Tensor, " object"] | None = None

    def corners(self, faces: Int64[Tensor, " n"]) -> tuple[Tensor, Tensor, Tensor]:
        """The three corners of the given triangles, ``[n, 3]`` each."""
        triangles = self.faces[faces]
        return tuple(self.vertices[triangles[:, k]] for k in range(3))  # type: ignore[return-value]

    def velocity(
        self, face: Int64[Tensor, " n"], b1: Float64[Tensor, " n"], b2: Float64[Tensor, " n"]
    ) -> Float64[Tensor, "n 3"] | None:
        """World velocity of material points [m/s]; None if all objects are at rest.

        Args:
            face: Triangles.
            b1, b2: Barycentric coordinates.
        """
        if self.velocities is None:
            return None
        v0, v1, v2 = (self.velocities[self.faces[face, k]] for k in range(3))
        return interpolate_values((v0, v1, v2), b1, b2)

    def require_static(self, depth: int) -> None:
        """Refuse paths of several bounces of objects in motion.

        Raises:
            InputError: An object moves.
        """
        if self.velocities is not None:
            raise InputError(
                f"expected depth 1 for objects in motion, got {depth}; the range rate of longer "
                "paths is not modelled"
            )


def is_visibility_differentiated(geometry: Geometry, link: Link) -> bool:
    """Test whether derivatives flow through vertices or antenna positions, which decide visibility.

    Args:
        geometry: scene as flat tables.
        link: antennas.
    """
    return any(is_differentiated(value) for value in (geometry.vertices, link.tx, link.rx))


def require_silhouette_samples(geometry: Geometry, link: Link, samples: int) -> None:
    """Refuse a derivative that would silently leave moving silhouettes out.

    Args:
        geometry: The scene.
        link: Antennas.
        samples: Number of silhouette samples.

    Raises:
        InputError: Silhouettes move and there are no samples of them.
    """
    if samples < 1 and is_visibility_differentiated(geometry, link):
        raise InputError(
            "expected boundary_samples >= 1 for a derivative in which silhouettes move, got "
            f"{samples}; give some, or boundary=False for fixed visibility"
        )


def require_surfaces(scene: Scene, hint: str = "mesh them") -> None:
    """Raise an error for point clouds.

    Args:
        scene: scene whose objects must be meshes.
        hint: remedy that ends the message.

    Raises:
        InputError: a cloud in the scene.
    """
    clouds = [name for name, item in scene.objects.items() if item.cloud is not None]
    if clouds:
        names = ", ".join(clouds)
        raise InputError(f"expected objects with surfaces, got clouds for {names}; {hint}")


def connect_surfaces(scene: Scene) -> tuple[Topology, Float64[Tensor, "v 3"]]:
    """Return the topology of all objects, and their vertices in the world where cracks close [m].

    Args:
        scene: scene whose objects must be meshes.

    Raises:
        InputError: a cloud in the scene.
    """
    require_surfaces(scene)
    parts = [item.vertices for item in scene.objects.values()]
    topology = topology_of([item.mesh for item in scene.objects.values()], parts)
    return topology, topology.join_vertices(parts)


def flatten(
    scene: Scene,
    wavelength: float,
    *,
    motion: Literal["refused", "fixed", "free"] = "refused",
    scenes: Sequence[int] | None = None,
) -> Geometry:
    """All objects of a scene in one set of tables.

    Args:
        scene: Its objects.
        wavelength: [m].
        motion: Whether objects may move, and whether derivatives flow through their velocities.
        scenes: Number of the scene of each object; None = one scene.

    Raises:
        InputError: An object in motion where a frame is one instant, a derivative with respect
            to a velocity, or an object that is a cloud.
    """
    objects = list(scene.objects.values())
    only = "only power (deposit_power, the surrogate) is computed of clouds"
    require_surfaces(scene, f"{only}: mesh them for exact signals")
    fitted = [n for n, o in scene.objects.items() if is_differentiated(o.velocity)]
    moving = fitted or [
        n for n, o in scene.objects.items() if o.velocity is not None and bool(o.velocity.any())
    ]
    if (fitted and motion != "free") or (moving and motion == "refused"):
        names = ", ".join(moving)
        what = "velocities without gradients, got" if fitted else "objects at rest, got"
        raise InputError(
            f"expected {what} velocities on {names}; a frame is one instant: use scene.at(time) "
            "and then replace(name, velocity=None), or simulate_chirps for motion within a frame"
        )
    parts = transform_vertices(objects)
    topology = topology_of([item.mesh for item in objects], parts, scenes)
    vertices = topology.join_vertices(parts)
    frequency, owner = SPEED_OF_LIGHT / wavelength, topology.face_object
    surfaces, face_surface = _collect_scattering_laws(objects, frequency, owner)
    skins = surfaces.refraction.any(1)
    for number in owner[skins[face_surface]].unique().tolist():
        if number in topology.open_objects:
            raise InputError(
                "expected a closed mesh for the refracting body "
                f"{list(scene.objects)[number]}, got an open one; close it "
                "(merge_meshes joins panels), or use a Slab for a sheet"
            )
    _warn_coarse_facets(list(scene.objects), topology, vertices, surfaces, face_surface)
    deforming = tuple(is_differentiated(item.mesh.vertices) for item in objects)
    weights, free = surfaces.lobes, is_differentiated(surfaces.lobes)
    return Geometry(
        vertices=vertices,
        faces=topology.faces,
        face_object=topology.face_object,
        face_surface=face_surface,
        surfaces=surfaces,
        has_lobe=tuple(free or bool(weight.any()) for weight in weights.T),
        has_sheets=bool(surfaces.transmittance.any()),
        has_refracting_bodies=bool(skins.any()),
        has_spread=bool((surfaces.spread != 1).any()),
        names=tuple(scene.objects),
        coherent=tuple(item.material.coherent for item in objects),
        differentiated=tuple(
            o or is_differentiated(i.pose) for o, i in zip(deforming, objects, strict=True)
        ),
        shape_differentiated=deforming,
        topology=topology,
        velocities=torch.cat([vertex_velocities(item) for item in objects]) if moving else None,
    )


def _warn_coarse_facets(
    names: list[str], topology: Topology, vertices: Tensor, surfaces: ScatteringLaw, rows: Tensor
) -> None:
    """Warn where a curved mesh is so coarse that its narrow lobes do not meet: it glints."""
    width = surfaces.exponents.detach().clamp_min(1e-9).rsqrt()
    narrow = torch.where(surfaces.lobes.detach() > 0, width, 1.0).amin(1)[rows]
    if not bool((narrow < _WIDE_LOBE).any()):
        return
    for number, name in enumerate(names):
        angle, lobe = topology.facet_angle(number, vertices), float("inf")
        if angle > 0:
            lobe = float(narrow[topology.face_object == number].min())
        if angle > lobe:
            warnings.warn(
                f"the triangles of {name} turn by {math.degrees(angle):.2g}° from one to the next, "
                f"more than its lobes are wide ({math.degrees(lobe):.2g}°): it glints where a "
                "smooth surface shines; use a finer mesh or a larger rms_slope",
                PhysicsWarning,
                stacklevel=2,
            )


def _scattering_law(material: Material, frequency: float) -> ScatteringLaw:
    """Evaluate the scattering law of a material; cached for frozen materials of plain numbers."""
    frozen = getattr(type(material), "__dataclass_params__", None)
    plain = all(isinstance(value, int | float | str) for value in vars(material).values())
    if plain and frozen is not None and frozen.frozen:
        return _cached_scattering_law(material, frequency)
    return material.scattering_law(frequency)


@lru_cache(maxsize=64)
def _cached_scattering_law(material: Material, frequency: float) -> ScatteringLaw:
    return material.scattering_law(frequency)


def _collect_scattering_laws(
    objects: list[Object], frequency: float, owner: Tensor
) -> tuple[ScatteringLaw, Tensor]:
    """The rows of all surfaces, and the row of every triangle.

    Objects of one material share its rows.

    Args:
        objects: Whose surfaces.
        frequency: [Hz].
        owner: Object of every triangle.
    """
    rows: dict[int, tuple[int, ScatteringLaw]] = {}  # the first row, and what the surface does
    of_material: dict[int, ScatteringLaw] = {}
    count, first, single = 0, [], []
    for item in objects:
        key, faces = id(item.material), len(item.mesh.faces)
        if key not in of_material:
            of_material[key] = _scattering_law(item.material, frequency)
        surface = of_material[key]
        per_face = surface.diffuse.ndim == 1
        if per_face and len(surface.diffuse) != faces:
            raise InputError(
                f"expected one value of a material per triangle ({faces}), got "
                f"{len(surface.diffuse)}; give as many, or a single one"
            )
        if id(surface) not in rows:
            rows[id(surface)] = count, surface
            count += faces if per_face else 1
        first.append(rows[id(surface)][0])
        single.append(not per_face)
    columns: dict[str, Tensor] = {}
    for name in (field.name for field in fields(ScatteringLaw)):
        laws = (law for _, law in rows.values())
        parts = [getattr(law, name)[None if law.diffuse.ndim == 0 else ...] for law in laws]
        columns[name] = torch.cat(parts)
    face_surface = torch.tensor(first)[owner]
    if not all(single):
        # Triangles of an object lie side by side, each with a row of its own.
        counts = torch.tensor([len(item.mesh.faces) for item in objects])
        number = torch.arange(len(owner)) - (counts.cumsum(0) - counts)[owner]
        face_surface += torch.where(torch.tensor(single)[owner], 0, number)
    return ScatteringLaw(**columns), face_surface


def vertex_velocities(item: Object) -> Float64[Tensor, "v 3"]:
    """World velocity of every vertex [m/s].

    Args:
        item: the object; zero at rest.
    """
    still = torch.zeros(len(item.mesh.vertices), 3, dtype=torch.float64)
    return still if item.velocity is None else still + item.velocity
