"""Read meshes and scene geometry from files, and write them."""

import math
import re
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import trimesh
from torch import Tensor
from trimesh import transformations
from trimesh.exchange.gltf import export_glb
from trimesh.resolvers import FilePathResolver
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from invertwin.checks import check_choice, checked_tensor
from invertwin.errors import InputError, PhysicsWarning, locate_errors
from invertwin.runtime.memory import require_at_most
from invertwin.scene import shapes
from invertwin.scene.material.materials import PerfectConductor, RoughConductor, RoughDielectric
from invertwin.scene.material.radio_materials import radio_bsdf, read_radio_material
from invertwin.scene.material.surface import Material
from invertwin.scene.mesh import Mesh
from invertwin.scene.mesh_defects import find_defects
from invertwin.scene.mesh_topology import sort_rows
from invertwin.scene.mesh_union import unite_parts
from invertwin.scene.pose import Basis
from invertwin.scene.scene import Object, Scene
from invertwin.storage import untrusted
from invertwin.storage.folders import replace_file

MESH_SUFFIXES = (".obj", ".ply", ".stl", ".gltf", ".glb", ".inp")
_Y_UP = (".gltf", ".glb")
_GLTF = Basis((0, 2, 1), (1, 1, -1))  # glTF 2.0, section 3.4: our (x, y, z) is its (x, z, −y)
_CORNERS = {"3": 3, "4": 4, "6": 3, "8": 4}  # corners of shell elements by the digit in their type
Unit = Literal["m", "cm", "mm", "um", "in", "ft"]
_METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254, "ft": 0.3048}
_UCD_HEADER = re.compile(r"(#.*\n|\s)*(\d+\s+){4}\d+\s*\n")  # counts: nodes, cells, data
_MAX_SHAPES, _MAX_BYTES = 10_000, 1e8  # of a file: two million triangles
#: What each group or node has, and how many there may be: trimesh takes long for them.
_GROUPS = {".obj": (b"usemtl ", 10_000), ".gltf": (b'"mesh"', 50_000), ".glb": (b'"mesh"', 50_000)}
_OBJ_LOST_LINE = re.compile(rb"^(?:[ \t]+[fv][ \t]|v\t).*$", re.M)
_OBJ_CORNER_ZERO = re.compile(rb"^f[ \t](?:.*[ \t])?[+-]?0+(?:[/ \t].*)?$", re.M)
_OBJ_RELATIVE_FACE = re.compile(rb"^f[ \t](?:.*[ \t])?-\d.*$", re.M)
_LARGE = 100.0  # size of a suspicious mesh [m]
CONCRETE = RoughDielectric(permittivity=5.24)
"""Default material of a scene file (ITU-R P.2040 concrete)."""


def load_mesh(file: str | Path, unit: Unit = "m") -> Mesh:
    """Load a triangle mesh from a file; `Mesh.summary` describes it.

    Vertices at equal positions are merged, unused vertices are dropped, the rest keep their order.
    Closed parts that overlap or touch become one surface, and triangles that are repeated are left
    out, which a warning says; it also names cracks, and triangles that lie on others.
    All parts of the file become one mesh (`load_parts` separates them). Axes are kept, except those
    of glTF, whose standard says y up: they are turned about x to z up, as Blender does. A mesh
    larger than 100 m causes a warning, since it may be in millimetres. From Abaqus and AVS UCD
    files (.inp) the corners of shell elements are read, in the coordinates of their definition;
    quadrilaterals are split.

    Args:
        file: path of an OBJ, PLY, STL, glTF, Abaqus or AVS UCD file; the suffix tells the format.
        unit: length unit of the file

    Raises:
        InputError: no such file, another format, a broken file, no triangles, NaN, or another
            unit.
    """
    return _load_with(file, unit, lambda scene: {"": scene.to_mesh()})[""]


def load_parts(file: str | Path, unit: Unit = "m") -> dict[str, Mesh]:
    """Load the parts of an OBJ, PLY, STL or glTF file, one for each name and material.

    Names are those of the file, of its objects or, in OBJ, of its materials; duplicates are
    numbered. All parts are in the frame of the file, with z up for glTF as in `load_mesh`.

    Args:
        file: path of an OBJ, PLY, STL or glTF file; the suffix determines the format.
        unit: length unit of the file

    Raises:
        InputError: as `load_mesh`.
    """

    whole = Path(file).name  # name of unnamed nodes

    def split_parts(scene: trimesh.Scene) -> dict[str, trimesh.Trimesh]:
        found: dict[str, trimesh.Trimesh] = {}
        for node in scene.graph.nodes_geometry:
            transform, name = scene.graph[node]
            mesh = scene.geometry[name].copy()
            if isinstance(mesh, trimesh.Trimesh):
                mesh.apply_transform(transform)
                # In glTF a node has a name, and each of its parts a material.
                material = getattr(getattr(mesh.visual, "material", None), "name", None)
                named = "" if str(node).startswith(whole) else str(node)
                label = ", ".join(dict.fromkeys(filter(None, (named, material)))) or str(node)
                found[f"{label} {len(found)}" if label in found else label] = mesh
        return found

    return _load_with(file, unit, split_parts)


@untrusted.safe_reader("a readable mesh")
def _load_with(
    file: str | Path, unit: Unit, split: Callable[[trimesh.Scene], Mapping[str, trimesh.Trimesh]]
) -> dict[str, Mesh]:
    path = untrusted.existing_file(file)
    check_choice(unit, _METRES, "a unit among")
    check_choice(path.suffix.lower(), MESH_SUFFIXES, "a mesh file of", f"convert {path.name} first")
    require_at_most(path.stat().st_size, _MAX_BYTES, "bytes of a mesh", "simplify it first")
    found = {}
    with untrusted.convert_read_errors(path, f"a readable {path.suffix} mesh"):
        for name, part in split(_load_trimesh_scene(path)).items():
            vertices = np.asarray(part.vertices, dtype=np.float64).reshape(-1, 3)
            if path.suffix.lower() in _Y_UP:
                vertices = _GLTF.inverse.vectors(torch.from_numpy(vertices)).numpy()
            faces = np.asarray(part.faces, dtype=np.int64).reshape(-1, 3)
            found[name] = vertices * _METRES[unit], faces
    with locate_errors(path):
        # Check the raw file first: merging would hide its defects.
        for vertices, faces in found.values():
            Mesh(torch.from_numpy(vertices.copy()), torch.from_numpy(faces.copy()))
        merged = {name: _merge_vertices(*part) for name, part in found.items()}
        meshes = {name: _drop_repetitions(unite_parts(mesh)) for name, mesh in merged.items()}
        if not meshes:
            raise InputError("expected triangles, got none; export the mesh again")
    for name, mesh in meshes.items():
        notes = [f"the mesh has {text}" for text in find_defects(mesh).in_words()]
        if mesh is not merged[name]:
            notes.append(
                "parts of the mesh overlap or touch, or are repeated; without what lies inside of "
                f"others, {len(merged[name].faces)} triangles are {len(mesh.faces)}"
            )
        if notes:
            warnings.warn(f"{path}: {'; '.join(notes)}", PhysicsWarning, stacklevel=3)
    extent = max(float(np.ptp(vertices, axis=0).max()) for vertices, _ in found.values())
    if extent > _LARGE:
        warnings.warn(
            f'{path}: a mesh {extent:.4g} m wide; if its numbers are millimetres, say unit = "mm"',
            PhysicsWarning,
            stacklevel=3,
        )
    return meshes


def save_mesh(path: str | Path, shape: Mesh | Scene) -> None:
    """Write a mesh, or all objects of a scene, as PLY (float64) or GLB (float32).

    A GLB file has the objects by name, and their materials by class name, metallic or not, which
    Blender and other programs import. Its axes are (x, z, −y), since glTF says y up; Blender shows
    the coordinates of the scene again. A PLY file has the axes of the scene.

    The write is atomic: a failure leaves an existing file unchanged.

    Args:
        path: output file, ending in .ply or .glb, in an existing folder.
        shape: mesh or scene to write.

    Raises:
        InputError: another suffix, or no such folder.
        OSError: the file system refuses the write.
    """
    file = Path(path)
    check_choice(file.suffix.lower(), (".ply", ".glb"), "a file name ending in", "rename it")
    if isinstance(shape, Mesh):
        parts = {"mesh": (shape.vertices, shape.faces, None)}
    else:
        parts = {k: (o.vertices, o.mesh.faces, o.material) for k, o in shape.objects.items()}
    looks = {id(material): _viewer_material(material) for *_, material in parts.values()}
    written = trimesh.Scene()
    glb = file.suffix.lower() in _Y_UP
    for name, (vertices, faces, material) in parts.items():
        points = vertices.detach().cpu()
        points = _GLTF.vectors(points) if glb else points
        mesh = trimesh.Trimesh(points.numpy(), faces.cpu().numpy(), process=False)
        if material is not None:
            mesh.visual = TextureVisuals(material=looks[id(material)])
        written.add_geometry(mesh, geom_name=name, node_name=name)
    with replace_file(file) as part:
        part.write_bytes(export_glb(written) if glb else _ply(written.to_mesh()))


@untrusted.safe_reader("a readable scene")
def load_scene_xml(
    path: str | Path, materials: Mapping[str, Material] | None = None, default: Material = CONCRETE
) -> Scene:
    """Load the geometry of a Mitsuba or Sionna scene file.

    Shapes of type obj, ply, rectangle, cube and sphere become objects in world coordinates, named
    by their id (or their type and number). The radio materials of Sionna RT become sheets (`Slab`);
    sensors, emitters and appearance are ignored.

    Args:
        path: XML file; its mesh files are relative to it.
        materials: material for each material id of the shapes, e.g. "mat-itu_concrete"; overrides
            the file.
        default: material of all other shapes.

    Raises:
        InputError: no such file, broken XML, something unsupported that would lose geometry, or a
            material id that no shape refers to.
    """
    file = untrusted.existing_file(path)
    with untrusted.convert_read_errors(file, "an XML scene"):
        root = ElementTree.parse(file).getroot()
        require_at_most(len(root), _MAX_SHAPES, "shapes", "join those of one material")
    with locate_errors(file):
        return _build_scene(root, file, dict(materials or {}), default)


def save_scene_xml(path: str | Path, scene: Scene) -> None:
    """Write a scene for Sionna RT: an XML file, and a PLY mesh for each object.

    Meshes are written to the folder `meshes` beside the file. Materials must be `Slab` or
    `PerfectConductor`; velocities are not stored.

    Args:
        path: output file, ending in .xml, in an existing folder.
        scene: scene to write.

    Raises:
        InputError: another suffix, no such folder, or a material without counterpart in Sionna RT.
        OSError: the write fails.
    """
    file = Path(path)
    check_choice(file.suffix.lower(), (".xml",), "a file name ending in", "rename the output")
    root = ElementTree.Element("scene", version="2.1.0")
    names: dict[int, str] = {}
    shapes = []
    for number, (name, item) in enumerate(scene.objects.items()):
        if id(item.material) not in names:
            names[id(item.material)] = f"material-{len(names)}"
            root.append(radio_bsdf(item.material, names[id(item.material)]))
        shape = ElementTree.Element("shape", type="ply", id=name)
        mesh = f"meshes/{number}.ply"
        ElementTree.SubElement(shape, "string", name="filename", value=mesh)
        ElementTree.SubElement(shape, "boolean", name="face_normals", value="true")
        ElementTree.SubElement(shape, "ref", id=names[id(item.material)], name="bsdf")
        shapes.append(shape)
    root.extend(shapes)
    ElementTree.indent(root)
    with replace_file(file) as part:
        (file.parent / "meshes").mkdir(exist_ok=True)
        for number, item in enumerate(scene.objects.values()):
            save_mesh(file.parent / "meshes" / f"{number}.ply", item.world_mesh)
        part.write_bytes(ElementTree.tostring(root))


class _FileResolver(FilePathResolver):
    """Files that a mesh names, such as its materials: in its folder, no pipes and no holes."""

    def get(self, name: str) -> bytes:
        file = untrusted.named_file(self.file_path, name)
        try:
            untrusted.existing_file(file)
        except InputError as error:
            raise OSError(str(error)) from None  # without its materials a mesh is whole
        return super().get(name)


def _load_trimesh_scene(path: Path) -> trimesh.Scene:
    suffix = path.suffix.lower()
    if suffix in _GROUPS:
        (mark, most), data = _GROUPS[suffix], path.read_bytes()
        require_at_most(data.count(mark), most, "groups or nodes", "join those of one material")
        if suffix == ".obj":
            _check_obj(data.replace(b"\r", b"").replace(b"\\\n", b""))
    if suffix != ".inp":
        return trimesh.load_scene(path, process=False, resolver=_FileResolver(str(path)))
    text = untrusted.read_text(path, "an .inp mesh")
    vertices, faces = _ucd(text) if _UCD_HEADER.match(text) else _abaqus(text)
    return trimesh.Scene(trimesh.Trimesh(vertices, faces, process=False))


def _check_obj(data: bytes) -> None:
    """Raise for faces that trimesh leaves out, or reads as other corners than the file means."""
    found = _OBJ_LOST_LINE.search(data) or _OBJ_CORNER_ZERO.search(data)
    if found := found or _OBJ_RELATIVE_FACE.search(data, 0, max(data.rfind(b"\nv "), 0)):
        raise InputError(
            "expected lines that begin with 'v ' or 'f ', and corners from 1, or −1 after all "
            f"vertices, got {found[0].decode(errors='replace'):.60}; export the mesh again"
        )


def _ucd(text: str) -> tuple[np.ndarray, np.ndarray]:
    """Parse vertices and triangles of the cells of an AVS UCD file; quadrilaterals are split."""
    lines = [line.split() for line in text.splitlines() if line.strip() and line[0] != "#"]
    nodes, cells = int(lines[0][0]), int(lines[0][1])
    places = {words[0]: (n, words[1:4]) for n, words in enumerate(lines[1 : 1 + nodes])}
    faces: list[list[int]] = []
    for _, _, kind, *corners in lines[1 + nodes : 1 + nodes + cells]:
        if kind not in ("tri", "quad"):
            raise ValueError(f"cells of type {kind}, no shells")
        used = [places[corner][0] for corner in corners]
        faces += [[used[0], used[k], used[k + 1]] for k in range(1, len(used) - 1)]
    vertices = np.array([place for _, place in places.values()], dtype=np.float64)
    return vertices, np.array(faces, dtype=np.int64)


def _abaqus(text: str) -> tuple[np.ndarray, np.ndarray]:
    """Parse vertices and triangles of the shell elements of an Abaqus file."""
    nodes: dict[str, int] = {}
    places: list[list[float]] = []
    faces: list[list[int]] = []
    keyword, corners, words = "", 0, []
    for line in text.splitlines():
        if line.startswith("**") or not line.strip():
            continue
        if line.startswith("*"):
            keyword, *options = line[1:].upper().replace(" ", "").split(",")
            if keyword == "PART":
                nodes = {}  # node numbers are local to a part
            kind = next((o[5:] for o in options if o.startswith("TYPE=")), "")
            corners, words = _count_corners(kind) if keyword == "ELEMENT" else 0, []
        elif keyword == "NODE":
            number, *place = line.split(",")[:4]
            nodes[number.strip()] = len(places)
            places.append([float(value) for value in place])
        elif keyword == "ELEMENT":
            words += [word.strip() for word in line.split(",") if word.strip()]
            if line.rstrip().endswith(","):
                continue  # the element continues on the next line
            used = [nodes[word] for word in words[1 : 1 + corners]]
            faces += [[used[0], used[k], used[k + 1]] for k in range(1, len(used) - 1)]
            words = []
    if not faces:
        raise ValueError("no shell elements")
    return np.array(places, dtype=np.float64), np.array(faces, dtype=np.int64)


def _count_corners(kind: str) -> int:
    """Return the number of corners of an element type such as S3, STRI65, S4R, R3D3; 0 for
    non-shells.
    """
    if not kind.startswith(("S", "R3D", "M3D", "CPS", "CPE", "DS", "SFM3D")):
        raise ValueError(f"elements of type {kind}, no shells")
    digits = [c for c in kind.replace("R3D", "").replace("M3D", "") if c.isdigit()]
    return _CORNERS[digits[0]]


def _merge_vertices(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    used = np.unique(faces)
    # Adding zero turns −0 into 0, the same position.
    places = vertices[used]
    _, first, group = np.unique(places + 0.0, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.argsort(order)
    renumbered = np.empty(len(vertices), dtype=np.int64)
    renumbered[used] = rank[group.ravel()]
    return Mesh(torch.from_numpy(places[first[order]]), torch.from_numpy(renumbered[faces]))


def _drop_repetitions(mesh: Mesh) -> Mesh:
    """Return the mesh with each triangle once, whichever way its corners go round."""
    order, start = sort_rows(*np.sort(mesh.faces.numpy(), axis=1).T, count=len(mesh.vertices))
    kept = np.sort(order[start])
    return mesh if len(kept) == len(order) else Mesh(mesh.vertices, mesh.faces[kept])


def _viewer_material(material: Material | None) -> PBRMaterial:
    """Return the viewer's name of a material, and whether it is a metal."""
    metal = isinstance(material, PerfectConductor | RoughConductor)
    return PBRMaterial(
        name=type(material).__name__,
        baseColorFactor=(190, 190, 195, 255) if metal else (205, 200, 190, 255),
        metallicFactor=float(metal),
        roughnessFactor=0.3 if metal else 0.9,
        doubleSided=True,  # surfaces reflect on both sides
    )


def _ply(mesh: trimesh.Trimesh) -> bytes:
    """Encode PLY in float64; trimesh writes float32."""
    vertices = np.asarray(mesh.vertices, dtype="<f8")
    faces = np.empty(len(mesh.faces), dtype=[("count", "<u1"), ("index", "<i4", 3)])
    faces["count"] = 3
    faces["index"] = mesh.faces
    places = "".join(f"property double {axis}\n" for axis in "xyz")
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{places}"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return header.encode() + vertices.tobytes() + faces.tobytes()


def _build_scene(
    root: ElementTree.Element, file: Path, materials: dict[str, Material], default: Material
) -> Scene:
    if root.tag != "scene" or root.find("include") is not None:
        raise InputError(
            f"expected one <scene> without <include>, got <{root.tag}>; merge the files into one"
        )
    objects: dict[str, Object] = {}
    referred = set()
    known = _read_materials(root) | materials
    for number, element in enumerate(root.findall("shape")):
        name = element.get("id") or f"{element.get('type')}_{number}"
        if name in objects:
            raise InputError(f"expected different shape ids, got {name!r} twice; rename one")
        named = [part for part in map(element.find, ("ref", "bsdf")) if part is not None]
        material = named[0].get("id", "") if named else ""
        referred.add(material)
        with locate_errors(f"shape {name!r}"):
            mesh = _shape(element, file)
        objects[name] = Object(mesh, known.get(material, default))
    unused = sorted(set(materials) - referred)
    if unused:
        listed = ", ".join(sorted(referred - {""})) or "none"
        raise InputError(
            f"expected material ids that shapes refer to ({listed}), got {', '.join(unused)}; "
            "correct the names in `materials`"
        )
    return Scene(objects)


def _read_materials(root: ElementTree.Element) -> dict[str, Material]:
    found: dict[str, Material] = {}
    for element in root.iter("bsdf"):
        name = element.get("id", "")
        with locate_errors(f"material {name!r}"):
            material = read_radio_material(element)
        if material is not None:
            found[name] = material
    return found


def _shape(element: ElementTree.Element, file: Path) -> Mesh:
    kind = element.get("type")
    if kind in ("obj", "ply"):
        name = _property(element, "string", "filename", "")
        with warnings.catch_warnings():  # scene files are in metres, however large
            warnings.simplefilter("ignore", PhysicsWarning)
            mesh = load_mesh(untrusted.named_file(file, name))
    elif kind == "rectangle":
        # Mitsuba's rectangle lies in the x-y plane and faces +z; ours in y-z faces −x.
        upright = shapes.plate(2.0, 2.0)
        mesh = Mesh(upright.vertices[:, [1, 2, 0]], upright.faces.flip(1))
    elif kind == "cube":
        mesh = shapes.box(2.0)
    elif kind == "sphere":
        ball = shapes.sphere(_numbers(_property(element, "float", "radius", "1"), 1)[0])
        mesh = Mesh(ball.vertices + _center(element), ball.faces)
    else:
        raise InputError(
            f"expected a shape of type obj, ply, rectangle, cube or sphere, got {kind!r}; "
            "export it as a ply mesh"
        )
    transform = _to_world(element)
    mirrored = bool(torch.linalg.det(transform[:3, :3]) < 0)
    flipped = _property(element, "boolean", "flip_normals", "false").lower() == "true"
    vertices = mesh.vertices @ transform[:3, :3].T + transform[:3, 3]
    return Mesh(vertices, mesh.faces.flip(1) if mirrored != flipped else mesh.faces)


def _property(shape: ElementTree.Element, tag: str, name: str, default: str) -> str:
    element = shape.find(f"{tag}[@name='{name}']")
    return default if element is None else element.get("value", default)


def _center(shape: ElementTree.Element) -> Tensor:
    element = shape.find("point[@name='center']")
    return torch.from_numpy(np.zeros(3) if element is None else _vector(element, 0.0))


def _to_world(shape: ElementTree.Element) -> Tensor:
    """Return the transform of a shape; its steps apply in document order."""
    transform = torch.eye(4, dtype=torch.float64)
    for element in shape.findall("transform[@name='to_world']/*"):
        step = checked_tensor(_step(element), (4, 4), element.tag, "correct the scene file")
        transform = step @ transform
    return transform


def _step(element: ElementTree.Element) -> np.ndarray:
    """Return the matrix of one step of a transform."""
    if element.tag == "translate":
        return transformations.translation_matrix(_vector(element, 0.0))
    if element.tag == "scale":
        return np.diag([*_vector(element, 1.0), 1.0])
    if element.tag == "rotate":
        axis = _vector(element, 0.0)
        if not axis.any():
            raise InputError("expected a rotation axis, got none; give x, y, z and angle (degrees)")
        (angle,) = _numbers(element.get("angle", ""), 1)
        return np.asarray(transformations.rotation_matrix(np.radians(angle), axis))
    if element.tag == "matrix":
        values = _numbers(element.get("value", ""), 9, 16)
        matrix, size = np.eye(4), math.isqrt(len(values))
        matrix[:size, :size] = np.reshape(values, (size, size))
        return matrix
    raise InputError(
        "expected translate, rotate, scale or matrix in to_world, "
        f"got {element.tag}; write it as a matrix"
    )


def _vector(element: ElementTree.Element, missing: float) -> np.ndarray:
    """Parse three numbers from `value` (one is repeated), or from x, y and z."""
    if "value" in element.attrib:
        values = _numbers(element.attrib["value"], 1, 3)
        values = values * 3 if len(values) == 1 else values
    else:
        values = [_numbers(element.get(axis, str(missing)), 1)[0] for axis in "xyz"]
    return np.array(values)


def _numbers(text: str, *counts: int) -> list[float]:
    try:
        values = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        values = []
    if len(values) not in counts:
        wanted = " or ".join(map(str, counts))
        raise InputError(f"expected {wanted} numbers, got {text!r}; correct the scene file")
    return values
