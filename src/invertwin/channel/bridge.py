"""The one crossing between torch and the ray tracer: backend choice, geometry, conversions."""

import os
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import cache, lru_cache
from typing import Any

import numpy as np
import torch
import torch.autograd.forward_ad as forward_ad
from jaxtyping import Float32, Float64, Int64
from torch import Tensor

from invertwin import doctor
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.scene.material import Material, Surface
from invertwin.scene.scene import Object, Scene

_VARIANTS = {"cpu": "llvm_ad_mono_polarized", "cuda": "cuda_ad_mono_polarized"}
_KEPT_TOPOLOGIES = 8
_UNGROUPED = 256  # triangles that are not worth a group
_chosen: list[str] = []


@cache
def _cuda_found() -> bool:
    doctor.require()
    import drjit as dr

    return bool(dr.has_backend(dr.JitBackend.CUDA))


def backend() -> str:
    """The ray tracer's backend in force: ``cpu`` or ``cuda``.

    The innermost :func:`use_backend` wins, then the environment variable ``INVERTWIN_BACKEND``,
    then ``auto``: CUDA where Dr.Jit finds it, the CPU elsewhere.

    Raises:
        InputError: A name that is not known, or CUDA asked for where there is none.
    """
    if _chosen:
        return _chosen[-1]
    return _resolved(os.environ.get("INVERTWIN_BACKEND", "auto"))


def _resolved(name: str) -> str:
    if name not in ("cpu", "cuda", "auto"):
        raise InputError(
            f"expected backend 'cpu', 'cuda' or 'auto', got {name!r}; "
            "correct the argument or INVERTWIN_BACKEND"
        )
    if name == "auto":
        return "cuda" if _cuda_found() else "cpu"
    if name == "cuda" and not _cuda_found():
        raise InputError("expected an NVIDIA GPU for backend 'cuda', got none; use backend 'cpu'")
    return name


@contextmanager
def use_backend(name: str | None) -> Iterator[None]:
    """Choose ``cpu``, ``cuda`` or ``auto`` inside a ``with`` block; ``None`` changes nothing."""
    _chosen.append(backend() if name is None else _resolved(name))
    try:
        yield
    finally:
        _chosen.pop()


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Keep torch to one thread inside a ``with`` block.

    What it does here is small, and its idle threads would spin on the cores that trace rays.
    """
    count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(count)


def tracer() -> Any:
    """The ``mitsuba`` module, set to the backend in force."""
    name = backend()
    mi = _loaded(name)
    if mi.variant() != _VARIANTS[name]:
        mi.set_variant(_VARIANTS[name])
    return mi


@cache
def _loaded(name: str) -> Any:
    doctor.require(name)
    import mitsuba

    return mitsuba


def to_float(values: Tensor) -> Any:
    """A flat Dr.Jit float array of a torch tensor (detached, float32)."""
    return tracer().Float(values.detach().to(torch.float32).contiguous().ravel().cpu())


def to_index(values: Tensor) -> Any:
    """A flat Dr.Jit index array of a torch tensor of non-negative integers."""
    return tracer().UInt32(values.detach().to(torch.int32).contiguous().ravel().cpu().numpy())


def to_points(values: Float64[Tensor, "n 3"] | Float32[Tensor, "n 3"]) -> Any:
    """A flat Dr.Jit array of four numbers a point, the last one zero: each is read as a whole."""
    return to_float(torch.nn.functional.pad(values.detach().to(torch.float32), (0, 1)))


def points(table: Any, index: Any, active: Any = True) -> Any:
    """Points of such an array."""
    import drjit as dr

    mi = tracer()
    found = dr.gather(mi.Vector4f, table, index, active)
    return mi.Point3f(found.x, found.y, found.z)


def from_points(values: Any) -> Float32[Tensor, "n 3"]:
    """Points, or derivatives by them, of such an array."""
    return to_torch(values).reshape(-1, 4)[:, :3]


def to_torch(values: Any) -> Tensor:
    """A torch tensor on the CPU of a flat Dr.Jit array."""
    return torch.from_numpy(np.array(values))


def opaque(value: float | int, kind: str = "UInt32") -> Any:
    """A Dr.Jit scalar that the kernel reads from memory, so that a new value does not recompile."""
    import drjit as dr

    return dr.opaque(getattr(tracer(), kind), value)


@dataclass(frozen=True)
class Geometry:
    """A scene as flat tables, still torch and differentiable.

    Attributes:
        vertices: World positions of all objects, concatenated [m].
        faces: Vertex indices of all triangles.
        face_object: Index of the object of each triangle.
        face_surface: Row of each triangle in the tables of surfaces.
        amplitude, diffuse, lobes, exponents, transmittance, excess, refraction, index,
            attenuation: Rows of ``scene.material.Surface``, one per object or per triangle.
        lobed: Which lobes have weight, or a derivative that could give them some.
        sheets: Whether something passes straight through any surface.
        bodies: Whether any surface is the skin of a refracting body.
        coherent: Per object, whether its field paths have a deterministic phase.
        topology: What depends on the connectivity only.
        velocities: World velocities of the vertices [m/s]; None = all at rest.
    """

    vertices: Float64[Tensor, "v 3"]
    faces: Int64[Tensor, "f 3"]
    face_object: Int64[Tensor, " f"]
    face_surface: Int64[Tensor, " f"]
    amplitude: Float64[Tensor, "row cos"]
    diffuse: Float64[Tensor, " row"]
    lobes: Float64[Tensor, "row 3"]
    exponents: Float64[Tensor, "row 3"]
    transmittance: Float64[Tensor, "row cos"]
    excess: Float64[Tensor, "row cos"]
    refraction: Float64[Tensor, "row cos"]
    index: Float64[Tensor, " row"]
    attenuation: Float64[Tensor, " row"]
    lobed: tuple[bool, bool, bool]
    sheets: bool
    bodies: bool
    coherent: tuple[bool, ...]
    topology: "Topology"
    velocities: Float64[Tensor, "v 3"] | None = None

    def corners(self, faces: Int64[Tensor, " n"]) -> tuple[Tensor, Tensor, Tensor]:
        """The three corners of the given triangles, ``[n, 3]`` each."""
        triangles = self.faces[faces]
        return tuple(self.vertices[triangles[:, k]] for k in range(3))  # type: ignore[return-value]


def differentiated(value: Tensor | None) -> bool:
    """Whether derivatives flow through a tensor, in reverse or in forward mode."""
    if value is None:
        return False
    return value.requires_grad or forward_ad.unpack_dual(value).tangent is not None


def flatten(scene: Scene, wavelength: float, *, in_motion: bool = False) -> Geometry:
    """All objects of a scene in one set of tables.

    Args:
        scene: Its objects.
        wavelength: [m].
        in_motion: Whether objects may move; their velocities are kept then.

    Raises:
        InputError: An object in motion where a frame is one instant, a derivative with respect
            to a velocity, or an object that is a cloud.
    """
    objects = list(scene.objects.values())
    clouds = [name for name, item in scene.objects.items() if item.cloud is not None]
    if clouds:
        raise InputError(
            f"expected objects with surfaces, got clouds for {', '.join(clouds)}; only power "
            "(deposit_power, the surrogate) is computed of clouds: mesh them for exact signals"
        )
    moving = [n for n, o in scene.objects.items() if _moves(o)]
    differentiable = [n for n, o in scene.objects.items() if differentiated(o.velocity)]
    if differentiable or (moving and not in_motion):
        names = ", ".join(differentiable or moving)
        what = "no derivatives by velocities, got" if differentiable else "objects at rest, got"
        raise InputError(
            f"expected {what} velocities on {names}; a frame is one instant: use scene.at(time) "
            "and then replace(name, velocity=None), or simulate_chirps for motion within a frame"
        )
    faces, owners, offset = [], [], 0
    for index, item in enumerate(objects):
        faces.append(item.mesh.faces + offset)
        owners.append(torch.full((len(item.mesh.faces),), index))
        offset += len(item.mesh.vertices)
    vertices = torch.cat([item.vertices for item in objects])
    key = (_VARIANTS[backend()], *(id(item.mesh.faces) for item in objects))
    # In the objects' own frames, where equal positions are equal to the last bit.
    shapes = torch.cat([item.mesh.vertices.detach() for item in objects])
    topology = _topology(key, [item.mesh.faces for item in objects], faces, owners, shapes)
    rows, face_surface = _surfaces(objects, SPEED_OF_LIGHT / wavelength)
    skins = rows["refraction"].any(1)
    for number, name in enumerate(scene.objects) if bool(skins.any()) else ():
        own = topology.face_object == number
        if bool(skins[face_surface[own]].any()):
            _require_solid(
                name, vertices.detach()[topology.faces[own]], topology.open_objects[number]
            )
    weights = rows["lobes"]
    free = differentiated(weights)
    return Geometry(
        vertices=vertices,
        faces=topology.faces,
        face_object=topology.face_object,
        face_surface=face_surface,
        **rows,
        lobed=(
            free or bool(weights[:, 0].any()),
            free or bool(weights[:, 1].any()),
            free or bool(weights[:, 2].any()),
        ),
        sheets=bool(rows["transmittance"].any()),
        bodies=bool(skins.any()),
        coherent=tuple(item.material.coherent for item in objects),
        topology=topology,
        velocities=torch.cat([_velocities(item) for item in objects]) if moving else None,
    )


def _require_solid(name: str, triangles: Tensor, is_open: bool) -> None:
    """Refuse a refracting body without an inside."""
    volume = (triangles[:, 0] * torch.linalg.cross(triangles[:, 1], triangles[:, 2])).sum() / 6
    if is_open or not volume > 0:
        found = "an open one" if is_open else "one wound inwards"
        raise InputError(
            f"expected a closed mesh with outward triangles for the refracting body {name}, got "
            f"{found}; close or turn it, or use a Slab for a sheet"
        )


def _surface(material: Material, frequency: float) -> Surface:
    """What a material does; remembered where it is frozen and of plain numbers."""
    frozen = getattr(type(material), "__dataclass_params__", None)
    plain = all(isinstance(value, int | float | str) for value in vars(material).values())
    if plain and frozen is not None and frozen.frozen:
        return _remembered(material, frequency)
    return material.surface(frequency)


@lru_cache(maxsize=64)
def _remembered(material: Material, frequency: float) -> Surface:
    return material.surface(frequency)


def _surfaces(objects: list[Object], frequency: float) -> tuple[dict[str, Tensor], Tensor]:
    """The rows of all surfaces, and the row of every triangle."""
    columns: dict[str, list[Tensor]] = {field.name: [] for field in fields(Surface)}
    face_surface, offset = [], 0
    for item in objects:
        surface, count = _surface(item.material, frequency), len(item.mesh.faces)
        per_face = surface.diffuse.ndim == 1
        if per_face and len(surface.diffuse) != count:
            raise InputError(
                f"expected one value of a material per triangle ({count}), got "
                f"{len(surface.diffuse)}; give as many, or a single one"
            )
        for name, column in columns.items():
            value = getattr(surface, name)
            column.append(value if per_face else value[None])
        numbers = torch.arange(count) if per_face else torch.zeros(count, dtype=torch.int64)
        face_surface.append(numbers + offset)
        offset += count if per_face else 1
    return {name: torch.cat(column) for name, column in columns.items()}, torch.cat(face_surface)


def _moves(item: Object) -> bool:
    return item.velocity is not None and bool(item.velocity.any())


def _velocities(item: Object) -> Tensor:
    """World velocity of every vertex [m/s]."""
    still = torch.zeros(len(item.mesh.vertices), 3, dtype=torch.float64)
    return still if item.velocity is None else still + item.velocity


class Topology:
    """Connectivity of a flattened scene and the ray tracer's copy of it.

    The acceleration structure is rebuilt only when the vertices differ from the last upload.
    """

    def __init__(self, faces: Tensor, face_object: Tensor, vertices: Tensor) -> None:
        mi = tracer()
        self.faces = faces
        self.face_object = face_object
        owners = range(int(face_object.max()) + 1)
        self.object_vertices = [faces[face_object == owner].unique() for owner in owners]
        self.sound_face: int | None = None  # a triangle that was no sliver when last looked at
        owner = torch.zeros(len(vertices), 1, dtype=torch.float64)
        owner[faces.ravel(), 0] = face_object.repeat_interleave(3).double()
        places = torch.cat([owner, vertices], dim=1).numpy()
        self.edges, self.opposite, beside = edges_of(faces.numpy(), places)
        alone = (self.opposite >= 0).sum(1) == 1
        lone_owner = face_object[beside[alone, 0]]
        self.open_objects = [bool((lone_owner == owner).any()) for owner in owners]
        self.device_faces = to_index(faces)
        self.device_edges = [to_index(self.edges[:, k]) for k in range(2)]
        self.device_opposite = [mi.Int32(column.copy()) for column in self.opposite.numpy().T]
        self.device_beside = [to_index(column) for column in beside.clamp_min(0).T]
        mesh = mi.Mesh("scene", vertex_count=len(vertices), face_count=len(faces))
        self._parameters = mi.traverse(mesh)
        self._parameters["faces"] = self.device_faces
        self._uploaded: Tensor | None = None
        self._mesh = mesh
        self._scene: Any = None

    def ray_scene(self, vertices: Tensor) -> Any:
        """The Mitsuba scene with these vertices (float32, never changed in place hereafter)."""
        if self._uploaded is vertices:
            return self._scene
        if self._uploaded is not None and torch.equal(self._uploaded, vertices):
            self._uploaded = vertices
            return self._scene
        self._build_tree(vertices)
        self._uploaded = vertices
        return self._scene

    def _build_tree(self, vertices: Tensor) -> None:
        mi = tracer()
        if self._scene is None:
            self._parameters["vertex_positions"] = to_float(vertices)
            self._parameters.update()
            self._scene = mi.load_dict({"type": "scene", **self._shapes()})
            self._parameters = mi.traverse(self._scene)
        else:
            key = next(k for k, _ in self._parameters.items() if k.endswith("vertex_positions"))
            self._parameters[key] = to_float(vertices)
            self._parameters.update()

    def _shapes(self) -> dict[str, Any]:
        """The mesh; on the CPU in a group, for which Embree builds its tree three times faster.

        Rays through a group take longer, so that small meshes, built in no time, stay without.
        """
        if backend() == "cuda" or len(self.faces) <= _UNGROUPED:
            return {"mesh": self._mesh}
        reference = {"type": "ref", "id": "group"}
        return {
            "group": {"type": "shapegroup", "mesh": self._mesh},
            "instance": {"type": "instance", "group": reference},
        }


_topologies: "OrderedDict[tuple, tuple[list[Tensor], Topology]]" = OrderedDict()


def _topology(
    key: tuple, owners: list[Tensor], faces: list[Tensor], objects: list[Tensor], vertices: Tensor
) -> Topology:
    """The cached topology; the entry holds the face tensors, so that their ids stay theirs."""
    if key not in _topologies:
        made = Topology(torch.cat(faces), torch.cat(objects), vertices)
        _topologies[key] = (owners, made)
        while len(_topologies) > _KEPT_TOPOLOGIES:
            _topologies.popitem(last=False)
    _topologies.move_to_end(key)
    return _topologies[key][1]


def edges_of(
    faces: np.ndarray, places: np.ndarray
) -> tuple[Int64[Tensor, "e 2"], Int64[Tensor, "e k"], Int64[Tensor, "e k"]]:
    """Edges of a triangle mesh, with opposite vertex and number of every triangle at the edge.

    Vertices with equal rows in ``places`` (object and position) count as one, so that a mesh
    with split vertices has no false open edges; objects that touch may part. The other two tables
    have as many columns as the edge with most triangles (2 for a manifold mesh); absent ones are
    −1.
    """
    _, first, inverse = np.unique(places, axis=0, return_index=True, return_inverse=True)
    welded = first[inverse.ravel()][faces]
    corners = [(0, 1, 2), (1, 2, 0), (2, 0, 1)]
    ends = np.concatenate([np.sort(welded[:, [a, b]], axis=1) for a, b, _ in corners])
    apex = np.concatenate([welded[:, c] for _, _, c in corners])
    proper = ends[:, 0] != ends[:, 1]
    triangle = np.tile(np.arange(len(faces)), 3)[proper]
    ends, apex = ends[proper], apex[proper]
    edges, group, counts = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(group.ravel(), kind="stable")
    start = np.repeat(np.cumsum(counts) - counts, counts)
    opposite = np.full((len(edges), counts.max(initial=1)), -1, dtype=np.int64)
    beside = opposite.copy()
    at = group.ravel()[order], np.arange(len(order)) - start
    opposite[at], beside[at] = apex[order], triangle[order]
    tables = edges.astype(np.int64), opposite, beside
    return torch.from_numpy(tables[0]), torch.from_numpy(tables[1]), torch.from_numpy(tables[2])
