"""Cases of `siege.py`: what lies in the folder, what is called there, and what must come of it."""

import base64
import io
import json
import os
import struct
import tarfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

RUN = """task = "simulate"
frame = 2
seed = 3

[scene.plate]
shape = "plate"
width = 0.4
height = 0.3
position = [1.2, 0.0, 0.0]
material = { kind = "rough_dielectric", permittivity = 4.0 }

[radar]
waveform = { kind = "fmcw", start_frequency = 76e9, bandwidth = 2e9, duration = 5e-5, samples = 32 }
transmitters = { kind = "positions", positions = [[0.0, 0.0, 0.0]] }
receivers = { kind = "linear", count = 4, spacing = 1.9e-3 }
positions = [[0.0, 0.0, 0.0], [0.0, 0.1, 0.0]]

[grid]
range_min = 0.8
range_max = 1.8
u_max = 0.6

[data]
kind = "simulated"
depth = 1
points_per_m2 = 50.0
snr_db = 20.0
"""
FIT = (
    RUN.replace('"simulate"', '"reconstruct"')
    + """
[truth.plate]
position = [1.2, 0.02, 0.01]

[[parameters]]
kind = "translation"
object = "plate"

[reconstruct]
depth = 1
steps = 2
samples = 2_000
boundary_samples = 500
checkpoint_every = 1
"""
)
DATASET = (
    RUN.replace('"simulate"', '"dataset"')
    + """
[dataset]
samples = 2
shard = 1
signals = ["map"]

[[vary]]
key = "data.snr_db"
kind = "normal"
mean = 20.0
deviation = 3.0
"""
)
CHECKED = """task = "gradcheck"
frame = 2

[scene.box]
shape = "box"
size = [0.6, 0.4, 0.5]
position = [0.2, 0.05, 0.1]
material = { kind = "perfect_conductor" }

[image]
kind = "silhouette"
objects = ["box"]

[gradcheck]
parameter = { kind = "translation", object = "box" }
tangent = { translation = [-0.5, 0.3, 0.8] }
step = 0.01
repeats = 1
max_pairs = 2
difference_samples = 2_000
"""
ARRAYS = """frame = 2
[data]
file = "adc.npy"
dimensions = ["frame", "chirp", "tx", "rx", "sample"]
[settings]
start_frequency = 77e9
slope = 60e12
sample_rate = 5e6
frame_period = 0.1
transmit_order = [1, 2]
receivers = [1, 2, 3, 4]
bits = 16
"""
CFG = """% Platform:xWR18xx
sensorStop
flushCfg
dfeDataOutputMode 1
channelCfg 15 3 0
adcCfg 2 1
adcbufCfg -1 0 0 1 1
profileCfg 0 77 0 0 3.2 0 0 60 0 16 5000 0 0 30
chirpCfg 0 0 0 0 0 0 0 1
chirpCfg 1 1 0 0 0 0 0 2
frameCfg 0 1 4 2 100 1 0
lvdsStreamCfg -1 0 1 0
sensorStart
"""
MATERIAL = '\nmaterial = { kind = "perfect_conductor" }\n'
PLANTED = "open('PWNED', 'w').close()\nraise SystemExit('PWNED')\n"
GIGABYTE = 1 << 30


@dataclass(frozen=True)
class Made:
    """What a case finds, beside the files in its folder.

    Attributes:
        env: Variables of the environment; None = not set.
        keep: Names of files that must stay as they are.
        check: What is wrong afterwards; empty where nothing is.
        undo: Called at the end.
    """

    env: Mapping[str, Any] = field(default_factory=dict)
    keep: Sequence[str] = ()
    check: Callable[[Path], str] = lambda _: ""
    undo: Sequence[Callable[[], Any]] = ()


@dataclass(frozen=True)
class Case:
    """An attack.

    Attributes:
        kind: The mechanism that it tries.
        name: Of the case.
        make: Writes the files.
        words: Of the command line; `-c` and code that calls the library.
        shell: In place of words, a line of a shell that calls `invertwin `.
        expects: A refusal of one line, or success.
        says: Words that must be in what it says.
        seconds: Limit of processor time.
    """

    kind: str
    name: str
    make: Callable[[Path], Made | None]
    words: Sequence[str] = ()
    shell: str = ""
    expects: Literal["refused", "done"] = "refused"
    says: Sequence[str] = ()
    seconds: float = 25.0


CASES: list[Case] = []


def texts(**files: str | bytes) -> Callable[[Path], None]:
    """A function that writes files; two underscores in a name stand for its dot."""

    def make(folder: Path) -> None:
        for name, content in files.items():
            data = content.encode() if isinstance(content, str) else content
            (folder / name.replace("__", ".")).write_bytes(data)

    return make


def add(
    kind: str, name: str, make: Callable[[Path], Made | None], *words: str, **more: Any
) -> None:
    """Add a case."""
    CASES.append(Case(kind, name, make, words, **more))


def code(kind: str, name: str, make: Callable[[Path], Made | None], text: str, **more: Any) -> None:
    """Add a case that calls the library."""
    CASES.append(Case(kind, name, make, ("-c", text), **more))


# Files that expand

_LOAD_VIEW = "from invertwin.viewer import Display; Display.load('view.npz')"
_LOAD_PRIOR = "from invertwin.scene.shape_models.prior import load_prior; load_prior('view.npz')"
_LOAD_BODY = "from invertwin.scene.people.body import load_smpl; load_smpl('view.npz')"
_LOOK = ("look", "adc.toml", "--board", "xWR1843", "--elevation", "1")
_LOOK_BIN = ("look", "adc.bin", "--config", "adc.cfg", "--board", "xWR1843", "--elevation", "1")


def npy_header(count: int) -> bytes:
    """Header of an `.npy` file of so many numbers."""
    head, plain = io.BytesIO(), {"descr": "<f8", "fortran_order": False, "shape": (count,)}
    np.lib.format.write_array_header_1_0(head, plain)
    return head.getvalue()


@cache
def zeros(wrapped: int) -> bytes:
    """3 GB of zeros, deflated: a block that ends at a byte, many times."""
    packer = zlib.compressobj(1, zlib.DEFLATED, wrapped)
    start = packer.flush(zlib.Z_FULL_FLUSH)
    block = packer.compress(bytes(1 << 24)) + packer.flush(zlib.Z_FULL_FLUSH)
    return start + block * (3 * GIGABYTE >> 24)


@cache
def zeros_checksum(start: bytes) -> int:
    """CRC of some bytes and 3 GB of zeros."""
    found = zlib.crc32(start)
    for _ in range(3 * GIGABYTE >> 24):
        found = zlib.crc32(bytes(1 << 24), found)
    return found


def npz_of_zeros(path: Path, name: str) -> None:
    """An archive of 3 MB that holds 3 GB."""
    size = 3 * GIGABYTE
    head = npy_header(size // 8)
    stored = b"\0" + struct.pack("<HH", len(head), len(head) ^ 0xFFFF) + head  # not compressed
    data = stored + zeros(-15) + b"\3\0"
    entry = f"{name}.npy".encode()
    sizes = struct.pack("<III", zeros_checksum(head), len(data), size + len(head))
    common = struct.pack("<HHHHH", 20, 0, 8, 0, 33) + sizes + struct.pack("<HH", len(entry), 0)
    local = b"PK\3\4" + common + entry + data
    central = b"PK\1\2\x14\0" + common + bytes(14) + entry
    end = b"PK\5\6" + struct.pack("<HHHHIIH", 0, 0, 1, 1, len(central), len(local), 0)
    path.write_bytes(local + central + end)


def mat_of_zeros(path: Path) -> None:
    """A file of MATLAB 5 whose one array is 3 GB of deflated zeros."""
    count = 3 * GIGABYTE // 8
    head = struct.pack("<IIIIII", 6, 8, 6, 0, 5, 8) + struct.pack("<ii", 1, count)
    head += struct.pack("<II", 1, 3) + b"adc".ljust(8, b"\0") + struct.pack("<II", 9, 8 * count)
    head = struct.pack("<II", 14, len(head) + 8 * count) + head
    stored = b"\0" + struct.pack("<HH", len(head), len(head) ^ 0xFFFF) + head
    packed = zeros(15)[:2] + stored + zeros(-15)
    text = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM"
    path.write_bytes(text + struct.pack("<II", 15, len(packed)) + packed)


def hdf5_of_fill(path: Path, name: str, shape: tuple[int, ...]) -> None:
    """A file of some kB whose array is fill values."""
    import h5py

    with h5py.File(path, "w") as file:
        file.create_dataset(name, shape, "f8", fillvalue=0.0, chunks=True)


def arrays_in(ending: str, write: Callable[[Path], None]) -> Callable[[Path], None]:
    """A described array in a file of another format."""

    def make(folder: Path) -> None:
        text = ARRAYS.replace('"adc.npy"', f'"adc.{ending}"\nvariable = "adc"')
        (folder / "adc.toml").write_text(text)
        write(folder / f"adc.{ending}")

    return make


def sparse(
    name: str, size: int = 4 * GIGABYTE, head: bytes = b"", real: bool = False, **others: Any
) -> Any:
    """A file that is a hole, or real zeros, beyond its first bytes, and others."""

    def make(folder: Path) -> None:
        texts(**others)(folder)
        with (folder / name).open("wb") as file:
            file.write(head)
            for _ in range(size >> 24 if real else 0):
                file.write(bytes(1 << 24))
            file.truncate(size)

    return make


for _name, _text in (("view", _LOAD_VIEW), ("prior", _LOAD_PRIOR), ("body", _LOAD_BODY)):
    _entry = {"view": "header", "prior": "codes", "body": "v_template"}[_name]
    code("expands", f"{_name}.npz", lambda f, e=_entry: npz_of_zeros(f / "view.npz", e), _text)
add("expands", "described .npz", arrays_in("npz", lambda p: npz_of_zeros(p, "adc")), *_LOOK)
add(
    "expands",
    "described .h5 of fill values",
    arrays_in("h5", lambda p: hdf5_of_fill(p, "adc", (8, 2, 2, 4, GIGABYTE // 128))),
    *_LOOK,
)
add("expands", "described .mat of zeros", arrays_in("mat", mat_of_zeros), *_LOOK)
add(
    "expands",
    "capture of fill values",
    lambda f: hdf5_of_fill(f / "data.nc", "beat", (2, 1, 4, GIGABYTE)),
    "look",
    "data.nc",
)
_HOLE: dict[str, Any] = {"adc__toml": ARRAYS}
add(
    "expands", "sparse .npy", sparse("adc.npy", 8 * GIGABYTE, npy_header(GIGABYTE), **_HOLE), *_LOOK
)
add("expands", ".npy that says more", sparse("adc.npy", 999, npy_header(GIGABYTE), **_HOLE), *_LOOK)
add("expands", "sparse .bin", sparse("adc.bin", 8 * GIGABYTE, adc__cfg=CFG), *_LOOK_BIN)
add("expands", "sparse .cfg", sparse("adc.cfg", head=CFG.encode(), adc__bin="x"), *_LOOK_BIN)
add("expands", "sparse run file", sparse("run.toml", head=RUN.encode()), "check", "run.toml")
add("expands", "sparse description", sparse("adc.toml", head=ARRAYS.encode()), *_LOOK)
add("expands", "sparse Touchstone", sparse("a.s2p", head=b"# Hz S RI R 50\n"), "look", "a.s2p")
add(
    "expands",
    "sparse channels",
    sparse("channels.json", adc__bin=bytes(4096).decode(), adc__cfg=CFG),
    *_LOOK_BIN,
    "--channels",
    "channels.json",
)
_LOAD_MESH = "from invertwin.scene.files import load_mesh; load_mesh('part{}')"
_LOAD_SET = (
    "from invertwin.datasets import SampleDataset; s = SampleDataset('set'); s.check(); s[0]"
)
code("expands", "sparse .ply", sparse("part.ply", head=b"ply\n"), _LOAD_MESH.format(".ply"))
code("expands", "sparse .obj", sparse("part.obj", head=b"v 0 0 0\n"), _LOAD_MESH.format(".obj"))
code("expands", "sparse .inp", sparse("part.inp", head=b"*NODE\n"), _LOAD_MESH.format(".inp"))


# Files that are none


def piped(name: str, before: Callable[[Path], Any] = lambda _: None) -> Callable[[Path], None]:
    """A pipe that nobody writes to, and other files."""

    def make(folder: Path) -> None:
        before(folder)
        (folder / name).parent.mkdir(exist_ok=True)
        os.mkfifo(folder / name)

    return make


def manifest(**changes: Any) -> str:
    """Manifest of a data set of one sample, with some of its values replaced."""
    shard = {"name": "shard-000000.tar", "first": 0, "samples": 1, "size": 1, "sha256": "0"}
    whole: dict[str, Any] = {
        "format": "invertwin data set 2",
        "samples": 1,
        "part": [1, 1],
        "fingerprint": "",
        "versions": {},
        "arrays": {"map": {"dims": ["frame"], "unit": ""}},
        "shards": [shard | changes.pop("shard", {})],
    }
    return json.dumps(whole | changes)


def shard_file(members: Mapping[str, bytes]) -> bytes:
    """A tar file."""
    made = io.BytesIO()
    with tarfile.open(fileobj=made, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for name, content in members.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            tar.addfile(entry, io.BytesIO(content))
    return made.getvalue()


def data_set(content: bytes | None = None, **changes: Any) -> Callable[[Path], None]:
    """A folder of a data set with one shard."""

    def make(folder: Path) -> None:
        (folder / "set").mkdir()
        (folder / "set" / "manifest.json").write_text(manifest(**changes))
        if content is not None:
            (folder / "set" / "shard-000000.tar").write_bytes(content)

    return make


_OBJ = "mtllib part.mtl\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
_GLTF = json.dumps(
    {"asset": {"version": "2.0"}, "buffers": [{"uri": "part.bin", "byteLength": 99}],
     "bufferViews": [{"buffer": 0, "byteLength": 99}], "scenes": [{"nodes": [0]}], "scene": 0,
     "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
     "nodes": [{"mesh": 0}], "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}]}
)  # fmt: skip
add("no file", "run file is a pipe", piped("run.toml"), "check", "run.toml")
add("no file", "run file is /dev/zero", lambda _: None, "check", "/dev/zero")
add("no file", "run.toml of a folder is a pipe", piped("fit/run.toml"), "view", "fit")
add("no file", "view.npz is a pipe", piped("view.npz"), "-c", _LOAD_VIEW)
add(
    "no file",
    "manifest of a folder is a pipe",
    piped("out/.invertwin.json", texts(s__toml=RUN)),
    *("simulate", "s.toml", "-o", "out", "--overwrite"),
)
add(
    "no file",
    "lock of a folder is a pipe",
    piped("out/.invertwin.lock", texts(s__toml=RUN)),
    *("simulate", "s.toml", "-o", "out", "--overwrite"),
)
code("no file", "manifest of a data set is a pipe", piped("set/manifest.json"), _LOAD_SET)
code("no file", "shard is a pipe", piped("set/shard-000000.tar", data_set()), _LOAD_SET)
code(
    "no file",
    "shard is read where it is a pipe",
    piped("set/shard-000000.tar", data_set()),
    "from invertwin.datasets import SampleDataset; SampleDataset('set')[0]",
)
code("no file", "mesh is a pipe", piped("part.obj"), _LOAD_MESH.format(".obj"))
code(
    "no file",
    ".mtl of a mesh is a pipe",
    piped("part.mtl", texts(part__obj=_OBJ)),
    _LOAD_MESH.format(".obj"),
    expects="done",
)
code(
    "no file",
    ".bin of a glTF is a pipe",
    piped("part.bin", texts(part__gltf=_GLTF)),
    _LOAD_MESH.format(".gltf"),
)
code(
    "no file",
    "mesh of a scene file is a pipe",
    piped(
        "part.ply",
        texts(
            scene__xml='<scene version="3.0.0"><shape type="ply" id="a">'
            '<string name="filename" value="part.ply"/></shape></scene>'
        ),
    ),
    "from invertwin.scene.files import load_scene_xml; load_scene_xml('scene.xml')",
)
add("no file", "recording is a pipe", piped("adc.bin", texts(adc__cfg=CFG)), *_LOOK_BIN)
add("no file", "settings are a pipe", piped("adc.cfg", texts(adc__bin=b"x")), *_LOOK_BIN)
add("no file", "description is a pipe", piped("adc.toml"), *_LOOK)
add("no file", "array is a pipe", piped("adc.npy", texts(**_HOLE)), *_LOOK)
add("no file", "capture is a pipe", piped("data.nc"), "look", "data.nc")
add("no file", "Touchstone is a pipe", piped("a.s2p"), "look", "a.s2p")
add(
    "no file",
    "channels are a pipe",
    piped("channels.json", texts(adc__cfg=CFG, adc__bin=bytes(4096))),
    *_LOOK_BIN,
    *("--channels", "channels.json"),
)
add("no file", "view of a pipe", piped("data.nc"), "view", "data.nc")


# Counts

_OBJECT = '[scene.o{}]\nshape = "plate"\nwidth = 1.0\nheight = 1.0\nposition = [{}.0, 0.0, 0.0]\n'
_MANY = range(100_000)
add(
    "counts",
    "100 000 objects",
    texts(run__toml=RUN + "".join(_OBJECT.format(k, k) + MATERIAL for k in _MANY)),
    *("check", "run.toml"),
)
add(
    "counts",
    "100 000 unknown keys",
    texts(run__toml="".join(f"scen{k} = 1\n" for k in _MANY) + RUN),
    *("check", "run.toml"),
)
add(
    "counts",
    "100 000 unknown keys of an object",
    texts(run__toml=RUN + "[scene.o]\n" + "".join(f"widt{k} = 1\n" for k in _MANY)),
    *("check", "run.toml"),
)
add(
    "counts",
    "100 000 parameters of unknown objects",
    texts(
        run__toml=FIT
        + "".join(f'[[parameters]]\nkind = "translation"\nobject = "plat{k}"\n' for k in _MANY)
    ),
    *("check", "run.toml"),
)
add(
    "counts",
    "100 000 truths of unknown objects",
    texts(run__toml=FIT + "".join(f"[truth.plat{k}]\nposition = [1.0, 0.0, 0.0]\n" for k in _MANY)),
    *("check", "run.toml"),
)
add(
    "counts",
    "10 000 000 positions in a list",
    texts(run__toml=RUN.replace("[0.0, 0.1, 0.0]]", "[0.0, 0.1, 0.0]," * 1_000_000 + "]")),
    *("check", "run.toml"),
)
_CORNERS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
for _word in ("g", "o", "usemtl"):
    _file = _CORNERS + "".join(f"{_word} x{k}\nf 1 2 3\n" for k in _MANY)
    code(
        "counts",
        f"OBJ of 100 000 {_word}",
        texts(part__obj=_file),
        _LOAD_MESH.format(".obj"),
        expects="refused" if _word == "usemtl" else "done",
    )
_STL = bytes(80) + struct.pack("<I", 8_000_000)
code(
    "counts",
    "STL of 400 MB of zeros",
    sparse("part.stl", len(_STL) + 50 * 8_000_000, _STL, real=True),
    _LOAD_MESH.format(".stl"),
)
_PLY = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex %d\nproperty float x\nproperty float y"
)
_PLY += b"\nproperty float z\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n"
code("counts", "PLY of 10⁹ corners", texts(part__ply=_PLY % 10**9), _LOAD_MESH.format(".ply"))
code(
    "counts",
    "PLY of 400 MB of zeros",
    sparse("part.ply", 400_000_000, _PLY % 33_000_000, real=True),
    _LOAD_MESH.format(".ply"),
)
_NODES = json.loads(_GLTF) | {"nodes": [{"mesh": 0, "name": f"n{k}"} for k in _MANY]}
_NODES["scenes"] = [{"nodes": list(_MANY)}]
_NODES["buffers"] = [
    {"uri": "data:application/octet-stream;base64," + base64.b64encode(bytes(99)).decode(),
     "byteLength": 99}
]  # fmt: skip
code(
    "counts",
    "glTF of 100 000 nodes",
    texts(part__gltf=json.dumps(_NODES)),
    _LOAD_MESH.format(".gltf"),
)
code(
    "counts",
    "scene file of 100 000 spheres",
    texts(
        scene__xml='<scene version="3.0.0">'
        + "".join(f'<shape type="sphere" id="s{k}"/>' for k in _MANY)
        + "</scene>"
    ),
    "from invertwin.scene.files import load_scene_xml; load_scene_xml('scene.xml')",
)


# Long words

_LONG = 100_000
add(
    "words", "integer of 100 000 bits", texts(r__toml="seed = 0x" + "F" * 25_000), "check", "r.toml"
)
add("words", "integer of 5 000 digits", texts(r__toml="seed = " + "9" * 5_000), "check", "r.toml")
add(
    "words",
    "dotted key of 5 000 parts",
    texts(r__toml='task = "simulate"\nx' + ".a" * 5_000 + " = 1\n"),
    *("check", "r.toml"),
)
add(
    "words",
    "dotted key of the run file's frame",
    texts(r__toml='task = "simulate"\nframe = 2\nx' + ".a" * 400 + " = 1\n"),
    *("check", "r.toml"),
)
add("words", "list of 20 000 levels", texts(r__toml="x = " + "[" * 20_000), "check", "r.toml")
add(
    "words",
    "key of 100 000 letters",
    texts(r__toml="a" * _LONG + " = 1\n" + RUN),
    "check",
    "r.toml",
)
add(
    "words",
    "name of 100 000 letters",
    texts(r__toml=RUN + f"[truth.{'a' * _LONG}]\nposition = [1.0, 0.0, 0.0]\n"),
    *("check", "r.toml"),
)
add(
    "words",
    "name of control characters",
    texts(r__toml=RUN + '[truth."\\u001b[31m\\n\\u202e"]\nposition = [1.0, 0.0, 0.0]\n'),
    *("check", "r.toml"),
)
for _given in (
    "receivers=[]",
    'transmitters={"a":1}',
    "samples=" + "9" * 5_000,
    "samples=" + "[" * _LONG,
):
    add(
        "words",
        f"look --set {_given[:24]}",
        texts(adc__bin=bytes(4096), adc__cfg=CFG),
        *_LOOK_BIN,
        *("--set", _given),
    )


# Outputs


def kept(name: str, text: str = "mine") -> Callable[[Path], Made]:
    """A run file, and a file that must stay."""

    def make(folder: Path) -> Made:
        texts(s__toml=RUN)(folder)
        if name != "s.toml":
            (folder / name).write_text(text)
        return Made(keep=[name])

    return make


add("outputs", "view --record over notes", kept("n.txt"), "view", "s.toml", "--record", "n.txt")
add(
    "outputs",
    "view --record over the run file",
    kept("s.toml"),
    "view",
    "s.toml",
    "--record",
    "s.toml",
)
add(
    "outputs",
    "view --record --overwrite over the run file",
    kept("s.toml"),
    *("view", "s.toml", "--record", "s.toml", "--overwrite"),
)
add(
    "outputs",
    "view --record in no folder",
    kept("s.toml"),
    "view",
    "s.toml",
    "--record",
    "no/p.html",
)
add("outputs", "view --record over a folder", kept("s.toml"), "view", "s.toml", "--record", ".")
add("outputs", "own capture", kept("capture.nc"), "simulate", "s.toml", "-o", ".")


def whole(name: str = "out") -> Callable[[Path], str]:
    """A check that a run is complete."""

    def check(folder: Path) -> str:
        lost = [n for n in ("metrics.json", "report.html") if not (folder / name / n).is_file()]
        return f"no {lost} in {name}" if lost else ""

    return check


def simulated(folder: Path) -> Made:
    """A run file whose run is complete afterwards."""
    texts(s__toml=RUN)(folder)
    return Made(check=whole())


for _end in ("> /dev/full", "| true", ">&-", "2> /dev/full", "> /dev/full 2>&1"):
    CASES.append(
        Case(
            "outputs",
            f"simulate {_end}",
            simulated,
            shell=f"invertwin simulate s.toml -o out {_end}",
            expects="done",
            seconds=60,
        )
    )


def mounted(kilobytes: int, run: str) -> Callable[[Path], Made]:
    """A disk that is nearly full, at `disk`; a limit of files where we may mount none."""

    def make(folder: Path) -> Made:
        texts(s__toml=run)(folder)
        disk = folder / "disk"
        disk.mkdir()
        mount = f"mount -t tmpfs -o size={kilobytes}k tmpfs '{disk}'"
        if os.system(mount + " 2> /dev/null"):
            return Made()
        return Made(undo=[lambda: os.system(f"umount '{disk}'")])

    return make


for _size in (24, 64):
    add(
        "full disk",
        f"simulate on {_size} kB",
        mounted(_size, RUN),
        *("simulate", "s.toml", "-o", "disk/out"),
        says=["make room"],
        seconds=60,
    )
add(
    "full disk",
    "reconstruct on 100 kB",
    mounted(100, FIT),
    "reconstruct",
    "s.toml",
    "-o",
    "disk/out",
    seconds=60,
)
add(
    "full disk",
    "dataset on 24 kB",
    mounted(24, DATASET),
    "dataset",
    "s.toml",
    "-o",
    "disk/out",
    seconds=60,
)
add(
    "full disk",
    "view --record on 24 kB",
    mounted(24, RUN),
    "view",
    "s.toml",
    "--record",
    "disk/p.html",
)
for _size in (8, 20, 40):
    CASES.append(
        Case(
            "full disk",
            f"simulate with files of {_size} kB",
            texts(s__toml=RUN),
            shell=f"ulimit -f {_size}; invertwin simulate s.toml -o out",
            says=["make room"],
            seconds=60,
        )
    )
code(
    "full disk",
    "save of a capture",
    mounted(8, RUN),
    "import torch\n"
    "from invertwin.capture import Capture\n"
    "from invertwin.cli.run_file import load_run\n"
    "from pathlib import Path\n"
    "from invertwin.cli.schema import build\n"
    "radar = build.radar(load_run(Path('s.toml')).radar)\n"
    "try:\n"
    "    Capture.from_beat(torch.ones(2, 1, 4, 32).to(torch.complex128), radar).save('disk/a.nc')\n"
    "except OSError as error:\n"
    "    from invertwin.errors import InputError\n"
    "    raise InputError(str(error)) from None\n",
)


# Planted modules


def planted(run: str, *names: str) -> Callable[[Path], Made]:
    """A run file beside modules that no one may import."""

    def make(folder: Path) -> Made:
        texts(s__toml=run)(folder)
        for name in names:
            (folder / f"{name}.py").write_text(PLANTED)
        return Made(check=lambda f: "a planted module ran" if (f / "PWNED").exists() else "")

    return make


_MODULES = ("multiprocessing", "numpy", "h5py", "torch", "json", "typing", "sitecustomize", "scipy")
add(
    "planted",
    "dataset by two workers",
    planted(DATASET, *_MODULES),
    *("dataset", "s.toml", "--workers", "2", "-o", "out"),
    expects="done",
    seconds=120,
)
add(
    "planted",
    "reconstruct by two workers",
    planted(FIT + '\n[starts]\nobject = "plate"\ncount = 2\ndistance = [0.05, 0.08]\n', *_MODULES),
    *("reconstruct", "s.toml", "--workers", "2", "-o", "out"),
    expects="done",
    seconds=180,
)
add("planted", "check", planted(RUN, *_MODULES), "check", "s.toml", expects="done", seconds=60)
add("planted", "doctor", planted(RUN, *_MODULES), "doctor", expects="done", seconds=60)


def planted_capture(folder: Path) -> Made:
    """A NetCDF file beside planted modules: a child process reads it."""
    hdf5_of_fill(folder / "data.nc", "beat", (2, 2))
    return planted(RUN, *_MODULES)(folder)


add("planted", "reader of a capture", planted_capture, "look", "data.nc")


# Numbers without limits

_NUMBERS = {
    "start frequency of 1e15 Hz": RUN.replace("76e9", "1e15"),
    "bandwidth of 2e15 Hz": RUN.replace("2e9", "2e15"),
    "SNR of -4000 dB": RUN.replace("snr_db = 20.0", "snr_db = -4000.0"),
    "SNR of 400 dB": RUN.replace("snr_db = 20.0", "snr_db = 400.0"),
    "permittivity of 1e300": RUN.replace("permittivity = 4.0", "permittivity = 1e300"),
    "range of 1e9 m": RUN.replace("range_max = 1.8", "range_max = 1e9"),
    "range step of 1e-12 m": RUN.replace("u_max = 0.6", "u_max = 0.6\nrange_step = 1e-12"),
    "10¹² points": RUN.replace("points_per_m2 = 50.0", "points_per_m2 = 1e13"),
    "2⁶⁴ receivers": RUN.replace("count = 4", f"count = {2**64}"),
    "-1 receivers": RUN.replace("count = 4", "count = -1"),
    "2³¹ samples": RUN.replace("samples = 32", f"samples = {2**31 - 1}"),
    "position of 1e300 m": RUN.replace("position = [1.2", "position = [1e300"),
    "plate of 1e200 m": RUN.replace("width = 0.4", "width = 1e200"),
    "position of 1e10 m": RUN.replace("position = [1.2", "position = [1e10"),
    "radar at 1e12 m": RUN.replace("[0.0, 0.1, 0.0]]", "[0.0, 1e12, 0.0]]"),
    "velocity above that of light": RUN.replace("[radar]", "velocity = [4e8, 0.0, 0.0]\n[radar]"),
    "elements 1e300 m apart": RUN.replace("spacing = 1.9e-3", "spacing = 1e300"),
    "ramp of 1e300 s": RUN.replace("duration = 5e-5", "duration = 1e300"),
    "starts from 1e6 m": FIT + '\n[starts]\nobject = "plate"\ncount = 2\ndistance = [1e6, 1e6]\n',
    "2³⁰ starts": FIT + f'\n[starts]\nobject = "plate"\ncount = {2**30}\ndistance = [0.05, 0.08]\n',
    "2⁶⁴ samples of a data set": DATASET.replace("samples = 2\n", f"samples = {2**64}\n"),
    "-1 samples of a data set": DATASET.replace("samples = 2\n", "samples = -1\n"),
}
for _name, _text in _NUMBERS.items():
    _command = _text.split('"')[1]
    for _which in ("check", _command):
        add("numbers", f"{_which}: {_name}", texts(s__toml=_text), _which, "s.toml")


def looked(**changes: str) -> Callable[[Path], None]:
    """A recording with other settings."""

    def make(folder: Path) -> None:
        np.save(folder / "adc.npy", np.zeros((2, 4, 2, 4, 16), np.complex64))
        text = ARRAYS
        for key, value in changes.items():
            text = "\n".join(
                f"{key} = {value}" if line.startswith(f"{key} =") else line
                for line in text.splitlines()
            )
        (folder / "adc.toml").write_text(text)

    return make


for _changes in (
    {"start_frequency": "77e12"},
    {"slope": "60e18"},
    {"slope": "60e3"},
    {"sample_rate": "5e15"},
    {"start_frequency": "1e300"},
    {"transmit_order": "[1, 99999999999999999999]"},
):
    _said = ", ".join(f"{key} = {value}" for key, value in _changes.items())
    add("numbers", f"look: {_said}", looked(**_changes), *_LOOK)


# `check` does not do the work, and says what the command says

_PLATE = """task = "rcs"
frame = 2
[scene.plate]
shape = "plate"
width = {0}
height = {0}
divisions = {1}
material = {{ kind = "perfect_conductor" }}
[rcs]
model = "moments"
frequencies = [3e9]
theta_deg = [90.0]
phi_deg = {{ start = 0.0, stop = 90.0, count = 19 }}
"""
add(
    "check",
    "gradcheck of an image without a camera",
    texts(s__toml=CHECKED),
    *("check", "s.toml"),
    says=["[camera]"],
)
for _which in ("check", "reconstruct"):
    _table = '[data]\nkind = "capture"\nfile = "none.nc"\n'
    add(
        "check",
        f"{_which}: capture that is missing",
        texts(
            s__toml=FIT[: FIT.index("[radar]")]
            + FIT[FIT.index("[grid]") : FIT.index("[data]")]
            + _table
            + FIT[FIT.index("[[parameters]]") :]
        ),
        *(_which, "s.toml"),
        says=["none.nc"],
    )
for _which in ("check", "simulate"):
    add(
        "check",
        f"{_which}: mesh that is missing",
        texts(s__toml=RUN + '[scene.car]\nfile = "none.obj"' + MATERIAL),
        *(_which, "s.toml"),
        says=["none.obj"],
    )


# Files of a run that hold something else


def views(change: Callable[[dict[str, Any]], dict[str, Any]]) -> Callable[[Path], None]:
    """A `view.npz` with other arrays."""

    def make(folder: Path) -> None:
        mesh = {
            "name": "twin/a",
            "kind": "surface",
            "points": {"array": "a0"},
            "faces": {"array": "a1"},
            "color": [1, 2, 3],
            "opacity": 1.0,
            "shown": True,
        }
        body = {"vertices": {"array": "a0"}, "faces": {"array": "a1"}}
        header = {
            "title": "t",
            "layers": [mesh],
            "steps": [{"number": 0, "label": "l", "bodies": {"a": body}}],
            "maps": {
                "": {"frames": [0], "ranges": [1.0, 2.0], "across": [0.0, 0.1, 0.2],
                     "power": {"measured": {"array": "a2"}}}
            },
            "up": [0.0, 0.0, 1.0],
            "ahead": [1.0, 0.0, 0.0],
            "format": 2,
        }  # fmt: skip
        arrays = {
            "header": header,
            "a0": np.eye(3, dtype=np.float32),
            "a1": np.array([[0, 1, 2]], np.int32),
            "a2": np.ones((1, 2, 3), np.float32),
        }
        made = change(arrays)
        made["header"] = np.array(json.dumps(made["header"]))
        np.savez(folder / "view.npz", **made)

    return make


def other(name: str, make: Callable[[np.ndarray], Any]) -> Callable[[Path], None]:
    """A `view.npz` with another array."""
    return views(lambda a: a | {name: make(a[name])})


def header(*path: Any, value: Any) -> Callable[[Path], None]:
    """A `view.npz` with another value in its header."""

    def change(arrays: dict[str, Any]) -> dict[str, Any]:
        box = arrays["header"]
        for step in path[:-1]:
            box = box[step]
        box[path[-1]] = value
        return arrays

    return views(change)


_SHOWN = (
    "from invertwin.viewer import Display, page_html\n"
    "from invertwin.viewer.display import Display\n"
    "d = Display.load('view.npz'); page_html(d); d.box, d.groups\n"
    "[d.show_step(s) for s in d.steps]; [m.maps_of_frame(0) for m in d.maps.values()]"
)
code("contents", "view.npz as it is", other("a0", lambda a: a), _SHOWN, expects="done")
for _array in ("a0", "a1", "a2"):
    for _kind in ("complex", "U8", ">f8"):
        code(
            "contents",
            f"view.npz: {_array} as {_kind}",
            other(_array, lambda a, k=_kind: a.astype(k)),
            _SHOWN,
        )
for _label, _spoil in {
    "NaN": lambda a: np.full(a.shape, np.nan, a.dtype) if a.dtype.kind == "f" else a[:, :2],
    "flat": lambda a: a.reshape(-1),
    "empty": lambda a: a[:0],
    "structured": lambda a: np.zeros(a.shape, [("x", "f8"), ("y", "f8")]),
    "one number": lambda a: a.reshape(-1)[0],
}.items():
    for _array in ("a0", "a1", "a2"):
        _may = _label == "empty" and _array == "a1"
        code(
            "contents",
            f"view.npz: {_array} {_label}",
            other(_array, _spoil),
            _SHOWN,
            expects="done" if _may or (_label, _array) == ("NaN", "a2") else "refused",
        )
for _path, _value in (
    (("title",), 5),
    (("layers", 0, "name"), None),
    (("layers", 0, "kind"), "cube"),
    (("layers", 0, "color"), [1, 2]),
    (("layers", 0, "color"), ["a", {}, []]),
    (("layers", 0, "opacity"), "x"),
    (("layers", 0, "shown"), []),
    (("layers", 0, "points"), [1, 2]),
    (("layers",), {}),
    (("layers",), 5),
    (("steps", 0, "label"), 7),
    (("steps", 0, "number"), "x"),
    (("steps", 0, "bodies"), []),
    (("up",), [0, 0]),
    (("up",), ["a", "b", "c"]),
    (("ahead",), 3),
    (("maps", "", "frames"), ["a"]),
    (("maps", "", "frames"), []),
    (("maps", "", "frames"), [0, 1]),
    (("maps", "", "ranges"), [1.0]),
    (("maps", "", "across"), {}),
    (("maps", "", "power"), [1]),
    (("maps",), []),
    (("format",), 3),
    (("strange",), 1),
):
    _where = ".".join(map(str, _path))
    code("contents", f"view.npz: {_where} = {_value}", header(*_path, value=_value), _SHOWN)

_READ_SET = (
    "from invertwin.datasets import SampleDataset\n"
    "s = SampleDataset('set'); len(s); s[0]; s[len(s) - 1]"
)
_NPY = io.BytesIO()
np.save(_NPY, np.ones((1, 2), np.float32))
_SHARD = shard_file({"00000000.map.npy": _NPY.getvalue(), "00000000.labels.json": b"{}"})
code("contents", "data set as it is", data_set(_SHARD), _READ_SET, expects="done")
for _label, _changes in {
    "-1 samples of a shard": {"shard": {"samples": -1}},
    "2⁶³ samples of a shard": {"shard": {"samples": 2**63}},
    "10¹² samples of a shard": {"shard": {"samples": 10**12}},
    "first sample -5": {"shard": {"first": -5}},
    "first sample 2⁶⁴": {"shard": {"first": 2**64}},
    "first sample 7": {"shard": {"first": 7}},
    "-1 samples": {"samples": -1},
    "no sample": {"shard": {"samples": 0}},
    "part 3 of 2": {"part": [3, 2]},
    "part of -1": {"part": [1, -1]},
    "shards elsewhere": {"shard": {"name": "../shard-000000.tar"}},
    "name of NUL": {"shard": {"name": "a\0b"}},
    "name of 5 000 letters": {"shard": {"name": "a" * 5_000}},
    "arrays of numbers": {"arrays": {"map": 5}},
    "no shards": {"shards": []},
}.items():
    code("contents", f"data set: {_label}", data_set(_SHARD, **_changes), _READ_SET)
for _label, _member in {
    "array that says 8 GB": ("00000000.map.npy", npy_header(GIGABYTE)),
    "pickled array": ("00000000.map.npy", b"\x93NUMPY\x01\0v\0{'descr': '|O', 'shape': (1,), }"),
    "array of dates": ("00000000.map.npy", None),
    "labels that are none": ("00000000.labels.json", b"[" * 100_000),
    "number of 5 000 digits": ("9" * 90 + ".map.npy", b""),
    "name that is no number": ("x.map.npy", b""),
}.items():
    _bytes = _member[1]
    if _bytes is None:
        _dates = io.BytesIO()
        np.save(_dates, np.zeros(3, "M8[s]"))
        _bytes = _dates.getvalue()
    code("contents", f"shard: {_label}", data_set(shard_file({_member[0]: _bytes})), _READ_SET)


# What the folder and the environment say


def styled(text: str | bytes) -> Callable[[Path], Made]:
    """A `matplotlibrc` in the working folder, which changes nothing."""

    def make(folder: Path) -> Made:
        texts(s__toml=RUN, matplotlibrc=text)(folder)
        return Made(check=whole())

    return make


for _label, _text in {
    "runs TeX": "text.usetex: True\n",
    "is damaged": "figure.figsize: x\n\0\n:::\n",
    "is no text": b"figure.figsize: \xff\xfe\n",
    "changes pictures": "figure.figsize: 400, 400\nfigure.dpi: 4000\nsavefig.dpi: 4000\n",
}.items():
    add(
        "environment",
        f"matplotlibrc {_label}",
        styled(_text),
        *("simulate", "s.toml", "-o", "out"),
        expects="done",
        seconds=60,
    )
_ASCII = {"PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
_LATIN = {"PYTHONIOENCODING": "latin-1", "PYTHONUTF8": "0"}
_C = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
for _label, _env in {"ASCII": _ASCII, "Latin-1": _LATIN, "C": _C}.items():

    def _make(folder: Path, env: Mapping[str, str] = _env) -> Made:
        texts(s__toml=RUN)(folder)
        return Made(env)

    for _words in (
        ("keys", "radar"),
        ("doctor",),
        ("check", "s.toml"),
        ("--help",),
        ("simulate", "s.toml"),
    ):
        add(
            "environment",
            f"{_label} terminal: {' '.join(_words)}",
            _make,
            *_words,
            expects="done",
            seconds=60,
        )
add(
    "environment",
    "ASCII terminal: an error with other letters",
    lambda f: texts(r__toml='task = "ü²"\nframe = 2\n')(f) or Made(_ASCII),
    *("check", "r.toml"),
)


def homeless(folder: Path) -> Made:
    """No HOME: nothing is made beside the results."""
    return Made(
        {"HOME": None, "XDG_CACHE_HOME": None},
        check=lambda f: "a folder ~ was made" if (f / "~").exists() else "",
    )


add("environment", "no HOME", homeless, "keys", expects="done")
add(
    "environment",
    "HOME that is no folder",
    lambda f: Made({"HOME": "/dev/null", "XDG_CACHE_HOME": None}),
    "keys",
    expects="done",
)
CASES.append(
    Case(
        "environment",
        "folder of a space, quotes and a newline",
        texts(s__toml=RUN),
        shell="mkdir -p $'a \\'b\"\\n c'; cp s.toml $'a \\'b\"\\n c/s ü.toml'; cd $'a \\'b\"\\n c';"
        " invertwin simulate \"'s ü.toml'\"",
        expects="done",
        seconds=60,
    )
)
