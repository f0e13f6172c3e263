"""Files: round trips, scene geometry as Mitsuba reads it, one-line errors, safe writes."""

import json
import math
import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from invertwin.errors import InputError, PhysicsWarning
from invertwin.scene import (
    Mesh,
    Object,
    PerfectConductor,
    RoughDielectric,
    Scene,
    Slab,
    box,
    load_mesh,
    load_parts,
    load_scene_xml,
    plate,
    rigid,
    rotation_from_vector,
    save_mesh,
    save_scene_xml,
    sphere,
    text,
)
from invertwin.scene.mesh import concatenate_meshes
from invertwin.storage.untrusted import read_arrays


def triangles(mesh: Mesh) -> np.ndarray:
    return mesh.vertices[mesh.faces].numpy()


def as_trimesh(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "gltf", "glb"])
def test_other_programs_meshes_are_read(tmp_path, suffix):
    mesh = box([0.3, 0.4, 0.5], divisions=2)
    path = tmp_path / f"box.{suffix}"
    exported = as_trimesh(mesh).export(file_type=suffix)
    # glTF comes as several files.
    parts = exported if isinstance(exported, dict) else {path.name: exported}
    for name, content in parts.items():
        target = path if name == "model.gltf" else tmp_path / name
        target.write_bytes(content.encode() if isinstance(content, str) else content)
    loaded = load_mesh(path)
    # STL repeats every corner: merging finds the same 26 vertices and no seam.
    assert loaded.vertices.shape == mesh.vertices.shape
    # glTF is y up: its (x, y, z) is our (x, −z, y).
    expected = triangles(mesh)
    if suffix in ("gltf", "glb"):
        expected = expected[..., [0, 2, 1]] * [1, -1, 1]
    assert np.allclose(triangles(loaded), expected, atol=1e-7)
    assert as_trimesh(loaded).is_watertight


def test_own_files_keep_every_bit(tmp_path):
    mesh = text("A")
    save_mesh(tmp_path / "letter.ply", mesh)
    loaded = load_mesh(tmp_path / "letter.ply")
    assert torch.equal(loaded.vertices, mesh.vertices)
    assert torch.equal(loaded.faces, mesh.faces)


def test_text_obj_with_normals_and_quads(tmp_path):
    path = tmp_path / "quad.obj"
    path.write_text(
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 9 9 9\nvn 0 0 1\nf 1//1 2//1 3//1 4//1\n"
    )
    mesh = load_mesh(path)
    # The vertex of no face is gone: it would spoil the centre.
    assert mesh.vertices.shape == (4, 3)
    assert len(mesh.faces) == 2
    assert mesh.center.tolist() == [0.5, 0.5, 0.0]


def test_open_and_degenerate_meshes_are_read(tmp_path):
    path = tmp_path / "odd.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 1 2\n")
    mesh = load_mesh(path)
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 1, 3], [0, 0, 1]]


def test_repeated_triangles_are_left_out(tmp_path):
    """Whichever way their corners go round, as programs write surfaces with two sides."""
    path = tmp_path / "double.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 2 1 3\nf 4 1 2\n")
    with pytest.warns(PhysicsWarning, match="repeated.*4 triangles are 2"):
        mesh = load_mesh(path)
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 1, 3]]


@pytest.mark.parametrize(
    ("offset", "named"),
    [((-0.15, 0.05, 0.02), "4 triangles on others"), ((-0.15 - 2e-5, 0, 0), None)],
    ids=["a patch", "in front of it"],
)
def test_patches_on_a_face_are_named(tmp_path, offset, named):
    body, patch = box((0.3, 0.4, 0.5)), plate(0.2, 0.25)
    patch = Mesh(patch.vertices + torch.tensor(offset).double(), patch.faces)
    save_mesh(tmp_path / "body.ply", concatenate_meshes([body, patch]))
    with warnings.catch_warnings(record=True) as issued:
        warnings.simplefilter("always")
        load_mesh(tmp_path / "body.ply")
    assert [named in str(w.message) for w in issued] == ([True] if named else [])


def test_cracks_are_named(tmp_path):
    """One plate of a box a hundredth of a millimetre off."""
    plates = [Mesh(box(0.4).vertices, pair) for pair in box(0.4).faces.split(2)]
    normal = torch.linalg.cross(*(plates[0].vertices[plates[0].faces[0]].diff(dim=0)))
    off = plates[0].vertices + 2e-4 * torch.nn.functional.normalize(normal, dim=0)
    save_mesh(tmp_path / "body.ply", concatenate_meshes([Mesh(off, plates[0].faces), *plates[1:]]))
    with pytest.warns(PhysicsWarning, match="8 edges along cracks 0.0002 m wide"):
        load_mesh(tmp_path / "body.ply")


def test_glb_keeps_names_and_materials(tmp_path):
    paint = RoughDielectric(3.0)
    scene = Scene(
        {
            "plate": Object(plate(1.0, 1.0), PerfectConductor()),
            "ball": Object(sphere(0.1, 1), paint),
            "wall": Object(plate(2.0, 1.0), paint, rigid(translation=torch.eye(3).double()[0])),
        }
    )
    save_mesh(tmp_path / "scene.glb", scene)
    read = trimesh.load_scene(tmp_path / "scene.glb")
    assert set(read.graph.nodes_geometry) == {"plate", "ball", "wall"}
    shown = {name: mesh.visual.material for name, mesh in read.geometry.items()}
    assert {name: look.name for name, look in shown.items()} == {
        "plate": "PerfectConductor",
        "ball": "RoughDielectric",
        "wall": "RoughDielectric",
    }
    assert shown["plate"].metallicFactor == 1.0
    assert shown["ball"].metallicFactor == 0.0
    assert shown["wall"].doubleSided
    assert len(load_mesh(tmp_path / "scene.glb").faces) == sum(
        len(item.mesh.faces) for item in scene.objects.values()
    )


def test_glb_stands_upright_where_y_is_up(tmp_path):
    block = box([0.1, 0.2, 3.0])
    mast = Mesh(block.vertices + torch.tensor([5.0, 1.0, 1.5]), block.faces)
    save_mesh(tmp_path / "mast.glb", mast)
    stored = trimesh.load_scene(tmp_path / "mast.glb").to_mesh().vertices
    # It is 5 m ahead, 1 m to the left and 3 m high. Blender's importer turns (x, y, z) to
    # (x, −z, y) again.
    assert np.allclose(np.ptp(stored, axis=0), [0.1, 3.0, 0.2])
    assert np.allclose(stored.mean(0), [5.0, 1.5, -1.0])
    back = load_mesh(tmp_path / "mast.glb")
    assert np.allclose(triangles(back), triangles(mast), atol=1e-6)
    assert as_trimesh(back).volume == pytest.approx(0.06, rel=1e-5)


def test_scene_is_saved_in_the_world(tmp_path):
    pose = rigid(
        rotation_from_vector(torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)),
        torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64),
    )
    scene = Scene(
        {
            "plate": Object(plate(1.0, 1.0), PerfectConductor(), pose),
            "ball": Object(sphere(0.1, 1), RoughDielectric(3.0)),
        }
    )
    save_mesh(tmp_path / "twin.ply", scene)
    loaded = load_mesh(tmp_path / "twin.ply")
    expected = torch.cat([scene[name].vertices[scene[name].mesh.faces] for name in scene.names])
    assert np.array_equal(triangles(loaded), expected.numpy())


def test_meshes_with_gradients_can_be_saved(tmp_path):
    mesh = plate(1.0, 1.0)
    save_mesh(tmp_path / "plate.ply", Mesh(mesh.vertices.clone().requires_grad_(), mesh.faces))
    loaded = load_mesh(tmp_path / "plate.ply")
    assert torch.equal(loaded.vertices, mesh.vertices)
    assert torch.equal(loaded.faces, mesh.faces)


@pytest.mark.parametrize("broken", ["write_bytes", "replace"])
def test_failed_write_leaves_the_old_file(tmp_path, monkeypatch, broken):
    path = tmp_path / "twin.ply"
    save_mesh(path, plate(1.0, 1.0))
    before = path.read_bytes()

    def fail(*args):
        if broken == "write_bytes":
            # A disk that is full half way through.
            with open(args[0], "wb") as file:
                file.write(args[1][:50])
        raise OSError("no space left on device")

    monkeypatch.setattr(Path if broken == "write_bytes" else os, broken, fail)
    with pytest.raises(OSError, match="no space left"):
        save_mesh(path, box(2.0))
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["twin.ply"]


def ply(vertex: str) -> str:
    """An ASCII file of one triangle with the given first vertex."""
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    return (
        f"ply\nformat ascii 1.0\nelement vertex 3\n{properties}element face 1\n"
        f"property list uchar int vertex_indices\nend_header\n{vertex}\n1 0 0\n0 1 0\n3 0 1 2\n"
    )


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("missing.ply", None, "an existing file, got .*missing.ply"),
        (
            "mesh.step",
            b"ISO-10303-21;",
            r"a mesh file of .obj, .*got '.step'; convert mesh.step",
        ),
        ("empty.obj", b"", "empty.obj"),
        ("empty.stl", b"", "empty.stl"),
        ("empty.ply", b"", "empty.ply"),
        ("empty.glb", b"", "empty.glb"),
        ("points.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "points.obj"),
        (
            "nan.obj",
            b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
            "got 1 NaN, infinite or above 1e.09 of 9",
        ),
        ("nan.ply", ply("0 nan 0").encode(), "got 1 NaN, infinite or above 1e.09 of 9"),
        (
            "zero.obj",
            b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 0/1 1/1 2/1\n",
            "from 1.*got f 0/1 1/1",
        ),
        ("last.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 \\\r\n00\n", "got f 1 2 00"),
        ("inset.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n f 1 3 2\n", "got  ?f 1 3 2"),
        (
            "relative.obj",
            b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 0 0 1\nf -3 -2 -1\n",
            "after all vertices, got f -3 -2 -1",
        ),
        (
            "nodes.gltf",
            b'{"nodes": [' + b'{"mesh": 0},' * 60_000 + b"{}]}",
            "at most 50,000 groups or nodes",
        ),
        ("index.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "index.obj"),
        ("index.ply", ply("0 0 0").replace("3 0 1 2", "3 0 1 7").encode(), "index.ply"),
        ("cut.ply", ply("0 0 0")[:150].encode(), "cut.ply"),
        ("random.ply", bytes(range(256)), "random.ply"),
        ("random.stl", bytes(range(256)), "random.stl"),
        ("random.gltf", b"{ not json", "random.gltf"),
        (
            "lost.gltf",
            b'{"asset": {"version": "2.0"}, "buffers": [{"uri": "no.bin"}]}',
            "lost.gltf",
        ),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path, name, content, message):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        load_mesh(path)
    assert "\n" not in str(caught.value)


def test_truncated_binary_file_is_refused(tmp_path):
    path = tmp_path / "letter.ply"
    save_mesh(path, text("A"))
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(InputError, match=r"letter.ply"):
        load_mesh(path)


@pytest.mark.parametrize("name", ["twin.obj", "no/folder/twin.ply"])
def test_bad_output_is_refused(tmp_path, name):
    with pytest.raises(InputError):
        save_mesh(tmp_path / name, plate(1.0, 1.0))


SCENE = """<scene version="3.0.0">
  <default name="spp" value="16"/>
  <integrator type="path"/>
  <emitter type="constant"/>
  <bsdf type="diffuse" id="mat-itu_concrete"/>
  <bsdf type="diffuse" id="mat-itu_metal"/>
  <shape type="ply" id="mesh-letter">
    <string name="filename" value="meshes/letter.ply"/>
    <boolean name="face_normals" value="true"/>
    <ref id="mat-itu_metal" name="bsdf"/>
    <transform name="to_world">
      <scale value="2"/>
      <rotate x="0" y="1" z="0" angle="30"/>
      <translate x="1" y="-2" z="3"/>
    </transform>
  </shape>
  <shape type="obj" id="mesh-box">
    <string name="filename" value="meshes/box.obj"/>
    <ref id="mat-itu_concrete"/>
    <transform name="to_world">
      <translate value="0.5, 0.25, -1"/>
      <rotate value="0.6 0 0.8" angle="-70"/>
      <scale x="1.5" z="0.5"/>
    </transform>
  </shape>
  <shape type="rectangle" id="floor">
    <transform name="to_world"><rotate x="1" angle="-90"/><scale x="4" y="1" z="5"/></transform>
  </shape>
  <shape type="cube">
    <transform name="to_world">
      <matrix value="0.5 0 0 1  0 -0.25 0.1 2  0 0 2 3  0 0 0 1"/>
    </transform>
    <ref id="mat-itu_concrete"/>
  </shape>
  <shape type="sphere" id="ball">
    <point name="center" x="1" y="0" z="-1"/>
    <float name="radius" value="0.7"/>
    <boolean name="flip_normals" value="true"/>
    <transform name="to_world"><translate y="2"/><scale value="2"/></transform>
  </shape>
</scene>
"""


def write_scene(folder: Path, content: str = SCENE) -> Path:
    (folder / "meshes").mkdir()
    save_mesh(folder / "meshes" / "letter.ply", text("A"))
    as_trimesh(box([1.0, 2.0, 3.0])).export(folder / "meshes" / "box.obj")
    path = folder / "scene.xml"
    path.write_text(content)
    return path


def signed_volume(item: Object) -> float:
    a, b, c = item.vertices[item.mesh.faces].unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum() / 6)


def test_scene_file_gives_named_objects_with_materials(tmp_path):
    metal = PerfectConductor()
    scene = load_scene_xml(write_scene(tmp_path), {"mat-itu_metal": metal})
    assert scene.names == ("mesh-letter", "mesh-box", "floor", "cube_3", "ball")
    assert scene["mesh-letter"].material is metal
    assert scene["floor"].material == RoughDielectric(5.24)
    other = load_scene_xml(tmp_path / "scene.xml", default=metal)
    assert all(item.material is metal for item in other.objects.values())


def test_scene_file_keeps_normals_outward(tmp_path):
    scene = load_scene_xml(write_scene(tmp_path))
    # The matrix of the cube mirrors it; the ball asks for inward normals.
    assert signed_volume(scene["cube_3"]) == pytest.approx(8 * 0.25)
    assert signed_volume(scene["mesh-letter"]) > 0
    assert signed_volume(scene["ball"]) < 0
    a, b, c = scene["floor"].vertices[scene["floor"].mesh.faces[0]]
    assert torch.linalg.cross(b - a, c - a)[1] > 0


READ_WITH_MITSUBA = """
import json, sys
import mitsuba
mitsuba.set_variant("scalar_rgb")
scene = mitsuba.load_file(sys.argv[1])
boxes = {}
for shape in scene.shapes():
    box = shape.bbox()
    boxes[shape.id()] = [list(map(float, box.min)), list(map(float, box.max))]
print(json.dumps(boxes))
"""


def test_scene_file_means_what_mitsuba_reads(tmp_path):
    path = write_scene(tmp_path)
    # In a process of its own: a variant set here would hold for all other tests.
    answer = subprocess.run(
        [sys.executable, "-c", READ_WITH_MITSUBA, str(path)],
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    boxes = json.loads(answer.stdout.splitlines()[-1])
    scene = load_scene_xml(path)
    for name in ("mesh-letter", "mesh-box", "floor", "ball"):
        low, high = (torch.tensor(corner, dtype=torch.float64) for corner in boxes[name])
        # The sphere of triangles touches its bounding box at vertices only.
        tolerance = 0.002 if name == "ball" else 1e-5
        vertices = scene[name].vertices
        assert torch.allclose(vertices.amin(0), low, atol=tolerance), name
        assert torch.allclose(vertices.amax(0), high, atol=tolerance), name


def shape(kind: str, content: str = "", name: str = "thing") -> str:
    return f'<scene version="3.0.0"><shape type="{kind}" id="{name}">{content}</shape></scene>'


def to_world(content: str) -> str:
    return shape("cube", f'<transform name="to_world">{content}</transform>')


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<scene", "expected an XML scene"),
        ("", "got an empty file"),
        ("<scene version='3.0.0'/>", "at least one named object"),
        ("<mesh/>", "expected one <scene> without <include>, got <mesh>"),
        ("<scene><include filename='a.xml'/></scene>", "without <include>"),
        (shape("disk"), "shape 'thing': .*got 'disk'; export it as a ply mesh"),
        (shape("ply", '<string name="filename" value="no.ply"/>'), "got .*no.ply; check the path"),
        (shape("ply"), "expected an existing file"),
        (shape("sphere", '<float name="radius" value="big"/>'), "1 numbers, got 'big'"),
        (shape("sphere", '<float name="radius" value="-1"/>'), "sphere radius"),
        (to_world("<lookat/>"), "translate, rotate, scale or matrix in to_world, got lookat"),
        (to_world('<matrix value="1 2 3"/>'), "9 or 16 numbers, got '1 2 3'"),
        (to_world('<rotate angle="3"/>'), "expected a rotation axis"),
        (to_world('<rotate x="1"/>'), "1 numbers, got ''"),
        (to_world('<translate value="1 2"/>'), "1 or 3 numbers, got '1 2'"),
        (to_world('<translate x="nan"/>'), "finite translate, got 1 NaN"),
        (
            "<scene><shape type='cube' id='a'/><shape type='cube' id='a'/></scene>",
            "different shape ids, got 'a' twice",
        ),
    ],
)
def test_bad_scene_files_are_refused_in_one_line(tmp_path, content, message):
    path = tmp_path / "scene.xml"
    path.write_text(content)
    with pytest.raises(InputError, match=message) as caught:
        load_scene_xml(path)
    assert "\n" not in str(caught.value)
    assert "scene.xml" in str(caught.value)


def test_misspelled_material_is_refused(tmp_path):
    path = write_scene(tmp_path)
    with pytest.raises(InputError, match=r"\(mat-itu_concrete, mat-itu_metal\), got itu_metal"):
        load_scene_xml(path, {"itu_metal": PerfectConductor()})


RADIO = """<scene version="2.1.0">
  <bsdf type="itu-radio-material" id="walls">
    <string name="type" value="glass"/><float name="thickness" value="0.01"/>
  </bsdf>
  <bsdf type="radio-material" id="own">
    <float name="relative_permittivity" value="3.5"/><float name="conductivity" value="0.1"/>
    <float name="scattering_coefficient" value="0.3"/>
  </bsdf>
  <shape type="cube" id="a"><ref id="walls" name="bsdf"/></shape>
  <shape type="cube" id="b"><ref id="own" name="bsdf"/></shape>
</scene>"""


def test_radio_materials_are_sheets(tmp_path):
    path = tmp_path / "radio.xml"
    path.write_text(RADIO)
    scene = load_scene_xml(path)
    assert scene["a"].material == Slab.itu("glass", thickness=0.01)
    assert scene["b"].material == Slab(3.5, 0.1, thickness=0.1, scattering=0.3)
    metal = PerfectConductor()
    assert load_scene_xml(path, {"own": metal})["b"].material is metal


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("glass", "glas", "material 'walls': .*did you mean glass"),
        ('value="3.5"', 'value="much"', "material 'own': expected relative permittivity"),
        ('value="0.3"', 'value="3"', "material 'own': expected scattering coefficient"),
    ],
)
def test_bad_radio_materials_are_refused_in_one_line(tmp_path, old, new, message):
    path = tmp_path / "radio.xml"
    path.write_text(RADIO.replace(old, new))
    with pytest.raises(InputError, match=message):
        load_scene_xml(path)


def test_written_scenes_are_read_again(tmp_path):
    glass, own = Slab.itu("glass", thickness=0.01), Slab(3.5, 0.1, thickness=0.2, scattering=0.3)
    turned = rigid(rotation_from_vector(torch.tensor([0.1, 0.2, 0.3]).double()))
    scene = Scene(
        {
            "pane": Object(box(0.3), glass, turned),
            "other pane": Object(box(0.4), glass),
            "wall": Object(box(0.5), own),
            "car": Object(box(0.6), PerfectConductor()),
        }
    )
    save_scene_xml(tmp_path / "scene.xml", scene)
    again = load_scene_xml(tmp_path / "scene.xml")
    assert again.names == scene.names
    assert [again[name].material for name in again.names] == [
        glass,
        glass,
        own,
        Slab.itu("metal", thickness=0.1, scattering=0.0),
    ]
    for name in scene.names:
        torch.testing.assert_close(again[name].vertices, scene[name].vertices, rtol=0, atol=0)


@pytest.mark.parametrize(
    "material",
    [
        RoughDielectric(4.0),
        Slab([3.0] * 12, thickness=0.1),
        Slab(3.0, thickness=0.1, loss_tangent=0.1),
        Slab(3.0, thickness=0.1, permeability=2.0),
    ],
)
def test_what_sionna_has_no_words_for_is_not_written(tmp_path, material):
    scene = Scene({"thing": Object(box(0.3), material)})
    with pytest.raises(InputError, match="expected a Slab of single numbers"):
        save_scene_xml(tmp_path / "scene.xml", scene)
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match=r"ending in \.xml"):
        save_scene_xml(tmp_path / "scene.txt", scene)


def test_missing_scene_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="expected an existing file"):
        load_scene_xml(tmp_path / "none.xml")


@pytest.mark.parametrize("damage", ["empty", "cut", "flipped", "plain array", "text"])
def test_damaged_arrays_are_one_error(damage, tmp_path):
    file, plain = tmp_path / "parts.npz", tmp_path / "plain.npy"
    np.savez_compressed(file, values=np.random.default_rng(0).normal(size=1000))
    np.save(plain, np.zeros(3))
    assert read_arrays(file, "look", ["values", "others"]).keys() == {"values"}
    content = file.read_bytes()
    middle = len(content) // 2
    spoilt = {
        "empty": b"",
        "cut": content[:-100],
        "flipped": content[:middle]
        + bytes(255 - b for b in content[middle : middle + 50])
        + content[middle + 50 :],
        "plain array": plain.read_bytes(),
        "text": b"no numbers",
    }
    file.write_bytes(spoilt[damage])
    with pytest.raises(
        InputError, match=r"expected plain arrays .*, got .*parts\.npz \(.*\); look$"
    ):
        read_arrays(file, "look")


@pytest.mark.usefixtures("unchecked")
def test_units_parts_and_materials_of_a_file(tmp_path):
    (tmp_path / "two.obj").write_text(
        "v 0 0 0\nv 100 0 0\nv 0 200 0\nv 0 0 300\n"
        "mtllib two.mtl\nusemtl steel\nf 1 2 3\nusemtl paint\nf 1 3 4\nf 1 4 2\n"
    )
    (tmp_path / "two.mtl").write_text("newmtl steel\nKd 1 0 0\nnewmtl paint\nKd 0 1 0\n")
    whole = load_mesh(tmp_path / "two.obj", unit="mm")
    found = whole.summary()
    assert found.extent == pytest.approx((0.1, 0.2, 0.3))
    assert (found.triangles, found.open_edges, found.nonmanifold_edges) == (3, 3, 0)
    assert str(found) == "0.1 × 0.2 × 0.3 m, 3 triangles, 3 open and 0 non-manifold edges"
    parts = load_parts(tmp_path / "two.obj", unit="mm")
    assert {name: len(part.faces) for name, part in parts.items()} == {"steel": 1, "paint": 2}
    assert parts["paint"].summary().extent == pytest.approx((0.1, 0.2, 0.3))
    with pytest.raises(InputError, match="a unit among m, cm"):
        load_mesh(tmp_path / "two.obj", unit="parsec")  # type: ignore[arg-type]
    with pytest.warns(PhysicsWarning, match=r'300 m wide.*unit = "mm"'):
        load_mesh(tmp_path / "two.obj")


ABAQUS = """*HEADING
a plate and a triangle, by hand
**
*PART, NAME=one
*Node
      1,  0.0, 0.0, 0.0
      2,  1.0, 0.0, 0.0
      7,  1.0, 1.0, 0.0
      8,  0.0, 1.0, 0.0
*Element, type=S4R, ELSET=all
10, 1, 2, 7, 8
*END PART
*PART, NAME=two
*NODE
1, 0, 0, 1
2, 1, 0, 1
3, 0, 1, 1
*ELEMENT, TYPE=STRI3
1, 1, 2,
3
"""


def test_shell_elements_of_an_abaqus_file(tmp_path):
    file = tmp_path / "parts.inp"
    file.write_text(ABAQUS)
    mesh = load_mesh(file)
    corners = mesh.vertices[mesh.faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert len(mesh.faces) == 3
    assert torch.allclose(normals[:, 2], torch.ones(3, dtype=torch.float64))
    assert corners[2, :, 2].tolist() == [1.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("type=S4R", "type=C3D8"),
        ("10, 1, 2, 7, 8", "10, 1, 2, 7, 9"),
        ("1.0, 1.0, 0.0", "1.0, one, 0.0"),
    ],
)
def test_other_abaqus_files_are_refused_in_one_line(tmp_path, old, new):
    file = tmp_path / "parts.inp"
    file.write_text(ABAQUS.replace(old, new))
    with pytest.raises(InputError, match=r"expected a readable \.inp mesh") as caught:
        load_mesh(file)
    assert "\n" not in str(caught.value)


UCD = """\
# AVS UCD
5 2 0 0 0
10 0.0 0.0 0.0
11 1.0 0.0 0.0
12 1.0 1.0 0.0
13 0.0 1.0 0.0
14 2.0 0.0 0.5
1 1 quad 10 11 12 13
2 1 tri 11 14 12
"""


def test_cells_of_an_ucd_file(tmp_path):
    (tmp_path / "plate.inp").write_text(UCD)
    mesh = load_mesh(tmp_path / "plate.inp")
    assert len(mesh.faces) == 3
    assert mesh.area == pytest.approx(1.0 + 0.5 * math.hypot(1.0, 0.5))


@pytest.mark.parametrize(("old", "new"), [("2 1 tri", "2 1 hex"), ("14 12", "15 12"), ("0.5", "x")])
def test_other_ucd_files_are_refused_in_one_line(tmp_path, old, new):
    (tmp_path / "plate.inp").write_text(UCD.replace(old, new))
    with pytest.raises(InputError, match=r"expected a readable \.inp mesh") as caught:
        load_mesh(tmp_path / "plate.inp")
    assert "\n" not in str(caught.value)
