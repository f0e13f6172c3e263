"""Every format that invertwin reads: small valid files, and what reads them."""

import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from email.message import Message
from http.cookies import CookieError
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import h5py
import msgspec
import numpy as np
import torch
from torch import nn

from cli.small import GRADCHECK, RUN, STARTS
from fuzz.damage import RAN, SOUND, Files
from invertwin.capture import (
    Capture,
    ChannelCalibration,
    ChirpData,
    ChirpSettings,
    load_rcs,
    load_touchstone,
    read,
    read_topic,
    read_track,
    ti,
)
from invertwin.capture.readers.described_arrays import write_chirps
from invertwin.cli.commands.check import run_check
from invertwin.cli.run_file import load_run, to_toml
from invertwin.cli.schema import build
from invertwin.cli.schema.keys import json_schema
from invertwin.datasets import SampleDataset
from invertwin.datasets.shards import (
    FORMAT,
    ArrayInfo,
    DatasetManifest,
    describe_shard,
    npy_bytes,
    pack_shard,
)
from invertwin.inversion.callbacks import Checkpoint
from invertwin.inversion.fingerprint import Fingerprint
from invertwin.inversion.fit import Fit, FitProgress
from invertwin.radar.boards import Mounting
from invertwin.radar.radar import Radar
from invertwin.radar.waveform import FMCW
from invertwin.scene import linear_array, plate
from invertwin.scene.files import load_mesh, load_scene_xml, save_mesh
from invertwin.scene.parameters import Translation
from invertwin.scene.people.body import load_smpl
from invertwin.scene.shape_models.lattice import Lattice
from invertwin.scene.shape_models.prior import Decoder, ShapePrior, load_prior
from invertwin.storage.run_folder import open_run
from invertwin.viewer import (
    AccessGuard,
    Display,
    DisplayLayer,
    DisplayMaps,
    DisplayMesh,
    DisplayStep,
    page_html,
)
from invertwin.viewer.guard import is_valid_message
from invertwin_convert import convert_file

ALL = ("bytes", "words", "values", "special")


@dataclass(frozen=True)
class Format:
    """What is read, and how it is damaged.

    Attributes:
        samples: Makes valid files; the one that is read comes first.
        read: What a user's call does with that file.
        levels: Of damage; those that are named twice are drawn twice as often.
        intact: Names of files that no damage may change or remove.
        short: Cases of the short test.
    """

    samples: Callable[[], list[Files]]
    read: Callable[[Path], Any]
    levels: tuple[str, ...] = ALL
    intact: tuple[str, ...] = ()
    short: int = 100


def _written(*writers: Callable[[Path], Any]) -> list[Files]:
    """The files that functions write, each into a folder of its own."""
    found = []
    for write in writers:
        with TemporaryDirectory() as name:
            first = write(Path(name))
            files = {path.name: path.read_bytes() for path in sorted(Path(name).iterdir())}
            found.append({first: files.pop(first), **files} if first else files)
    return found


# Run files


def _read_run(path: Path) -> None:
    run = load_run(path)
    to_toml(run)
    scene = build.true_scene(run)
    if run.radar is not None and run.grid is not None:
        build.grid(run.grid, build.radar(run.radar))
    build.parameters(run.parameters, scene, run.scene)


def _runs() -> list[Files]:
    plain = RUN.replace("task", 'title = "small"\ntask', 1)
    checked = RUN.replace("reconstruct", "gradcheck", 1) + GRADCHECK
    mesh = _written(lambda folder: save_mesh(folder / "part.ply", plate(1.0, 1.0)))[0]["part.ply"]
    file = RUN.replace('shape = "plate"\nwidth = 2.0\nheight = 2.0', 'file = "part.ply"')
    return [
        {"run.toml": plain.encode()},
        {"run.toml": (RUN + STARTS).encode()},
        {"run.toml": checked.encode()},
        {"run.toml": file.encode(), "part.ply": mesh},
    ]


def _old_runs() -> list[Files]:
    """Run files of the first frame, which `invertwin convert` reads."""
    json_schema()  # kept on disk by the first who asks
    return [{"run.toml": files["run.toml"].replace(b"frame = 2", b"")} for files in _runs()]


# Numbers without physical limits: what is estimated before a run begins

_SIMULATED = RUN.replace('"reconstruct"', '"simulate"')
_DATASET = (
    RUN.replace('"reconstruct"', '"dataset"')
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
_RCS = """task = "rcs"
frame = 2
[scene.plate]
shape = "plate"
width = 0.1
height = 0.1
divisions = 2
material = { kind = "perfect_conductor" }
[rcs]
model = "moments"
frequencies = [3e9]
theta_deg = [90.0]
phi_deg = { start = 0.0, stop = 90.0, count = 19 }
"""


def _estimates() -> list[Files]:
    fit, checked = RUN + STARTS, RUN.replace("reconstruct", "gradcheck", 1) + GRADCHECK
    return [{"run.toml": text.encode()} for text in (_SIMULATED, fit, checked, _DATASET, _RCS)]


def _read_estimate(path: Path) -> None:
    run_check(load_run(path))


# Meshes

_OBJ = b"""# a tetrahedron
mtllib part.mtl
o part
v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
vn 0 0 1
vt 0 0
usemtl paint
f 1/1/1 3/1/1 2/1/1
f 1//1 2//1 4//1
f 2 3 4
f -4 -1 -2
"""
_MTL = b"newmtl paint\nKd 0.5 0.5 0.5\nmap_Kd paint.png\n"
_XML = b"""<?xml version="1.0"?>
<scene version="3.0.0">
  <bsdf type="diffuse" id="paint"/>
  <shape type="ply" id="part"><string name="filename" value="part.ply"/>
    <transform name="to_world"><translate x="1" y="2" z="3"/>
      <rotate x="0" y="1" z="0" angle="30"/><scale value="2"/></transform>
    <ref id="paint"/></shape>
  <shape type="sphere" id="ball"><float name="radius" value="0.5"/>
    <point name="center" x="0" y="0" z="2"/></shape>
  <shape type="cube"><transform name="to_world">
    <matrix value="1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"/></transform></shape>
</scene>
"""


def _meshes() -> list[Files]:
    import trimesh
    from trimesh.exchange import gltf

    box = trimesh.creation.box()

    def exported(name: str, **how: Any) -> Callable[[Path], str]:
        def write(folder: Path) -> str:
            box.export(folder / name, **how)
            return name

        return write

    def parts(name: str) -> Callable[[Path], str]:
        scene = trimesh.Scene({"a": box, "b": trimesh.creation.icosphere(0)})

        def write(folder: Path) -> str:
            files = gltf.export_gltf(scene)
            for file, data in files.items():
                (folder / file).write_bytes(data)
            return "model.gltf"

        def write_glb(folder: Path) -> str:
            (folder / name).write_bytes(gltf.export_glb(scene))
            return name

        return write if name.endswith("gltf") else write_glb

    def own(folder: Path) -> str:
        save_mesh(folder / "own.ply", plate(1.0, 1.0, 2))
        return "own.ply"

    def xml(folder: Path) -> str:
        (folder / "scene.xml").write_bytes(_XML)
        save_mesh(folder / "part.ply", plate(1.0, 1.0, 1))
        return "scene.xml"

    return [
        {"part.obj": _OBJ, "part.mtl": _MTL},
        {"ucd.inp": _UCD},
        {"abaqus.inp": _ABAQUS},
        *_written(
            exported("box.stl"),
            exported("text.stl", file_type="stl_ascii"),
            exported("box.ply"),
            exported("text.ply", encoding="ascii"),
            parts("model.gltf"),
            parts("model.glb"),
            own,
            xml,
        ),
    ]


_UCD = b"""# AVS UCD
4 2 0 0 0
10 0.0 0.0 0.0
11 1.0 0.0 0.0
12 1.0 1.0 0.0
13 0.0 1.0 0.5
1 1 quad 10 11 12 13
2 1 tri 11 13 12
"""
_ABAQUS = b"""*HEADING
*NODE
1, 0, 0, 0
2, 1, 0, 0
3, 0, 1, 0
4, 1, 1, 1
*ELEMENT, TYPE=S4R
1, 1, 2, 4, 3
*ELEMENT, TYPE=STRI3
2, 1, 2,
3
"""


def _read_mesh(path: Path) -> None:
    (load_scene_xml if path.suffix == ".xml" else load_mesh)(path)


# Captures and described arrays

_SETTINGS = ChirpSettings(
    start_frequency=77e9,
    slope=60e12,
    sample_rate=5e6,
    samples=8,
    transmit_order=(1, 2),
    receivers=(1, 2, 3, 4),
    loops=2,
    frames=2,
    frame_period=0.1,
    idle_time=7e-6,
    lanes=2,
)


def _captures() -> list[Files]:
    waveform = FMCW(77e9, 2e9, 5e-5, 8)
    places = torch.tensor([[0.0, 0, 0], [0, 0.1, 0]], dtype=torch.float64)
    generator = torch.Generator().manual_seed(1)

    def beat(folder: Path) -> str:
        radar = Radar(linear_array(1, 1e-3), linear_array(2, 2e-3), waveform, positions=places)
        samples = torch.randn(2, 1, 2, 8, dtype=torch.complex128, generator=generator)
        Capture.from_beat(samples, radar, torch.arange(2.0).double()).save(folder / "beat.nc")
        return "beat.nc"

    def profile(folder: Path) -> str:
        radar = Radar(linear_array(1, 1e-3), linear_array(1, 1e-3), waveform, positions=places)
        samples = torch.randn(2, 9, dtype=torch.complex128, generator=generator)
        ranges = torch.linspace(1, 2, 9, dtype=torch.float64)
        Capture.from_range_profile(samples, ranges, radar, survey=places).save(folder / "p.nc")
        return "p.nc"

    return _written(beat, profile)


def _read_capture(path: Path) -> None:
    found = Capture.load(path, trusted=_sound(path))
    found.radar().elements()
    _ = found.max_range, found.track, found.survey, found.clock_offset, found.range_bias


def _sound(path: Path) -> bool:
    """Whether the libraries wrote the file: a child process would take most of the time."""
    return path.with_name(SOUND).exists()


def _arrays(*endings: str) -> Callable[[], list[Files]]:
    def write(ending: str) -> Callable[[Path], str]:
        def written(folder: Path) -> str:
            write_chirps(folder / "adc.toml", _chirps(), f"adc.{ending}")
            return "adc.toml"

        return written

    return lambda: _written(*map(write, endings))


def _chirps() -> ChirpData:
    counts = torch.arange(2 * 2 * 2 * 4 * 8).reshape(2, 2, 2, 4, 8) % 1000
    return ChirpData(torch.complex(counts.float(), -counts.float()), _SETTINGS)


def _mats() -> list[Files]:
    def seven(folder: Path) -> str:
        write_chirps(folder / "adc.toml", _chirps(), "adc.h5")
        text = (folder / "adc.toml").read_text().replace("adc.h5", "adc.mat")
        (folder / "adc.toml").write_text(text)
        with h5py.File(folder / "adc.h5") as old, h5py.File(folder / "adc.mat", "w") as new:
            new["adc"] = np.asarray(old["adc"]).T
        (folder / "adc.h5").unlink()
        return "adc.toml"

    return [*_arrays("mat")(), *_written(seven)]


_SWEEP = "# MHz S RI R 50\n100 0.5 0.1 0.2 0 0.2 0 1 1\n110 0.4 0 0.1 0 0.1 0 1 1\n"
_RAIL = """frame = 2
[data]
files = "at_*.s2p"
[sweep]
background = "empty.s2p"
parameter = "S21"
dwell = 1e-3
[radar]
positions = "rail.csv"
look_at = [3.0, 0.0, 0.0]
tx_positions = [[0.0, -0.1, 0.0]]
range_center = [2.0, 0.0, 0.0]
"""
_PASS = """frame = 2
[data]
file = "pass.npz"
variable = "fp"
dimensions = ["sample", "frame"]
conjugate = true
[sweep]
frequencies = "freq"
[radar]
positions = ["x", "y", "z"]
range_origin = "r0"
"""


def _sweeps() -> list[Files]:
    def history(folder: Path) -> str:
        (folder / "pass.toml").write_text(_PASS)
        rows: dict[str, Any] = {name: np.arange(3.0) for name in ("x", "y", "z", "r0")}
        fp = np.ones((4, 3), complex)
        np.savez(folder / "pass.npz", fp=fp, freq=1e9 + 1e6 * np.arange(4), **rows)
        return "pass.toml"

    files = {name: _SWEEP.encode() for name in ("at_0.s2p", "at_1.s2p", "empty.s2p")}
    rail = {"rail.toml": _RAIL.encode(), **files, "rail.csv": b"x,y,z\n0,0,0\n0,0.1,0\n"}
    return [rail, {"at_0.s2p": _SWEEP.encode()}, *_written(history)]


def _read_sweeps(path: Path) -> None:
    found = read(path)
    _ = found.max_range, found.radar().range_limits


def _read_arrays(path: Path) -> None:
    found = read(path, board=Mounting("xWR1843", 1), trusted=_sound(path))
    _ = found.max_range, found.frame_count


# Arrays by name


def _npz() -> list[Files]:
    rng = np.random.default_rng(1)

    def body(folder: Path) -> str:
        count, joints = 12, 3
        regressor, weights = rng.random((joints, count)), rng.random((count, joints))
        np.savez(
            folder / "body.npz",
            v_template=rng.normal(size=(count, 3)),
            f=rng.integers(0, count, (8, 3)).astype(np.uint32),
            weights=weights / weights.sum(1, keepdims=True),
            kintree_table=np.array([[2**32 - 1, 0, 1], [0, 1, 2]], dtype=np.uint32),
            J_regressor=regressor / regressor.sum(1, keepdims=True),
            shapedirs=rng.normal(size=(count, 3, 4)) * 0.01,
            posedirs=rng.normal(size=(count, 3, 18)) * 0.01,
        )
        return "body.npz"

    def prior(folder: Path) -> str:
        torch.manual_seed(1)
        decoder = Decoder(2, 3, 4, 5 * 3 * 5).double()
        lattice = Lattice.from_bounds([-1.0, -1, -1], [1.0, 1, 1], [5, 5, 5])
        ShapePrior(decoder, lattice).save(folder / "prior.npz")
        return "prior.npz"

    return [*_written(body, prior), *_arrays("npz", "npy")()]


def _read_npz(path: Path) -> None:
    if path.suffix == ".toml":
        _read_arrays(path)
    elif path.stem == "body":
        load_smpl(path)
    else:
        load_prior(path).values(torch.zeros(2).double())


# Boards, calibrations


def _boards() -> list[Files]:
    def cfg(folder: Path) -> str:
        ti.write_samples(folder / "adc.bin", _chirps())
        ti.write_cfg(folder / "adc.cfg", _SETTINGS)
        return "adc.cfg"

    def studio(folder: Path) -> str:
        ti.write_samples(folder / "adc.bin", _chirps())
        ti.write_studio(folder / "adc.mmwave.json", _SETTINGS)
        ti.write_setup(folder / "a.setup.json", folder / "adc.mmwave.json", [folder / "adc.bin"])
        return "a.setup.json"

    return _written(cfg, studio)


def _read_board(path: Path) -> None:
    cfg = path.suffix == ".cfg"
    found = read(
        path.with_name("adc.bin") if cfg else path,
        path if cfg else None,
        board=Mounting("xWR1843", 1),
    )
    _ = found.max_range, found.frame_count


def _channels() -> list[Files]:
    gains = torch.tensor([[1 + 1j, 0.5], [0.9j, 1.0]], dtype=torch.complex128)
    return _written(
        lambda folder: ChannelCalibration(gains).save(folder / "channels.json") or "channels.json"
    )


# What a run leaves


def _fit() -> Fit:
    """What of a fit a checkpoint knows, without rays."""
    fit = object.__new__(Fit)
    fit.modules, fit.number, fit.is_last = nn.ModuleList([Translation("ball")]), 0, True
    fit.fingerprint = Fingerprint("a fit", torch.arange(3.0))
    fit.optimizer = optimizer = torch.optim.Adam(fit.modules.parameters(), lr=0.1)
    fit.modules[0].translation.grad = torch.ones(3, dtype=torch.float64)  # type: ignore[union-attr]
    optimizer.step()
    first = {name: value.clone() for name, value in fit.modules.state_dict().items()}
    row = {"step": 0, "stage": 0, "loss": 1.5, "values": {"ball.translation": [0.0, 0.0, 0.0]}}
    fit.progress = FitProgress(first, 1, [row], (0, 1.5, first))
    return fit


def _checkpoints() -> list[Files]:
    def write(folder: Path) -> str:
        Checkpoint(folder / "checkpoint.pt").end(_fit())
        return "checkpoint.pt"

    return _written(write)


def _read_checkpoint(path: Path) -> None:
    fit = _fit()
    Checkpoint(path, resume=True).begin(fit)
    assert isinstance(fit.optimizer, torch.optim.Adam)
    fit.optimizer.step()
    torch.save(fit.state(), path.with_name("again"))


_TEXTS = {"run": "seed = 1\n"}


def _manifests() -> list[Files]:
    def whole(folder: Path) -> str:
        with open_run(folder / "out", _TEXTS) as run:
            run.write_text("metrics.json", "{}")
        return ".invertwin.json"

    def interrupted(folder: Path) -> str:
        try:
            with open_run(folder / "out", _TEXTS) as run:
                run.write_text("parts/start0.json", "{}")
                raise KeyboardInterrupt
        except KeyboardInterrupt:
            return ".invertwin.json"

    found = []
    for write in (whole, interrupted):
        with TemporaryDirectory() as name:
            write(Path(name))
            data = (Path(name) / "out" / ".invertwin.json").read_bytes()
        found.append({"manifest.json": data, "victim": b"mine", "notes.txt": b"mine"})
    return found


def _read_manifest(path: Path) -> None:
    for number, how in enumerate(({"resume": True}, {"overwrite": True}, {})):
        out = path.with_name(f"out{number}")
        (out / "unfinished" / "parts").mkdir(parents=True)
        for name in ("metrics.json", "run.toml", "unfinished/parts/start0.json"):
            (out / name).write_text("{}")
        (out / "link").symlink_to(path.parent)
        if path.is_file() and path.stat().st_size < 1 << 30:
            (out / ".invertwin.json").write_bytes(path.read_bytes())
        else:
            (out / ".invertwin.json").symlink_to(path)
        try:
            with open_run(out, _TEXTS, **how) as run:
                if not run.complete:
                    run.write_text("metrics.json", "new")
                    _ = run.run_files
        except ValueError:
            if number == 2:
                raise


# Displays, data sets, and what clients of a viewer say


def _views() -> list[Files]:
    def write(folder: Path) -> str:
        points, faces = np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32)
        step = DisplayStep(0, "step 0", {"a": DisplayMesh(points, faces)})
        maps = DisplayMaps([0], [1.0, 2.0], [0.0, 0.1], {"measured": np.ones((1, 2, 2), "f4")})
        layers = [DisplayLayer("twin/a", "surface", points, faces)]
        Display("title", layers, [step], {"": maps}).save(folder / "view.npz")
        return "view.npz"

    return _written(write)


def _read_view(path: Path) -> None:
    found = Display.load(path)
    page_html(found)
    _ = found.box, found.groups, [found.show_step(step) for step in found.steps]


def _data_sets() -> list[Files]:
    members = {"map.npy": npy_bytes(np.ones((2, 3), np.float32)), "labels.json": b'{"a": 1}'}
    content = pack_shard((k, members) for k in range(2))
    manifest = DatasetManifest(
        format=FORMAT,
        samples=2,
        part=(1, 1),
        fingerprint="f",
        versions={"invertwin": "0"},
        arrays={"map": ArrayInfo(dims=["range", "u"], unit="1")},
        shards=[describe_shard("shard-000000.tar", 0, 2, content)],
    )
    text = manifest.model_dump_json().encode()
    return [{"manifest.json": text, "shard-000000.tar": content}]


def _read_data_set(path: Path) -> None:
    found = SampleDataset(path.parent)
    _ = found[0], found[len(found) - 1]


_MESSAGES = (
    {"type": "GuiUpdateMessage", "uuid": "slider", "updates": {"value": 3}},
    {"type": "GuiUpdateMessage", "uuid": "choice", "updates": {"value": "a"}},
    {"type": "TransformControlsUpdateMessage", "name": "/gizmo", "wxyz": [1.0, 0.0, 0.0, 0.0]},
    {"type": "SceneNodeClickMessage", "name": "/maps/a", "ray_origin": [0.0, 0.0, 0.0]},
)
_GUARD = AccessGuard("127.0.0.1")
_CONTROLS = {
    "slider": SimpleNamespace(min=0, max=4, value=1),
    "choice": SimpleNamespace(options=("a", "b"), value="a"),
    "box": SimpleNamespace(value=True),
}


def _messages() -> list[Files]:
    request = b"GET /?token=a HTTP/1.1\r\nHost: 127.0.0.1:8080\r\nOrigin: http://127.0.0.1:8080\r\n"
    request += b"Cookie: invertwin_8080=a\r\n\r\n"
    return [
        *({"message.json": json.dumps(message).encode()} for message in _MESSAGES),
        {"request.txt": request},
    ]


def _read_message(path: Path) -> None:
    data = path.read_bytes()
    if path.suffix == ".txt":
        _read_request(data)
        return
    is_valid_message(data, _CONTROLS)
    try:
        message = json.loads(data)
        packed = msgspec.msgpack.encode(message)
    except (ValueError, OverflowError, RecursionError):
        return
    if is_valid_message(packed, _CONTROLS) and message["type"] == "GuiUpdateMessage":
        value = message["updates"]["value"]
        assert list(message["updates"]) == ["value"]
        assert value in ("a", "b", True, False) or 0 <= value <= 4


def _read_request(data: bytes) -> None:
    class Headers(Message):
        def get_all(self, name: str) -> list[str]:  # type: ignore[override]
            return super().get_all(name, [])

    line, *rest = data.decode("latin-1").split("\r\n")
    headers = Headers()
    for row in rest:
        name, _, value = row.partition(":")
        try:
            headers[name] = value.strip()
        except ValueError:
            return
    path = [*line.split(" "), "/"][1]
    try:
        admitted = _GUARD.admits(path, headers, 8080)
    except (ValueError, CookieError):
        return  # answered by 400
    hosts = {"127.0.0.1:8080", "localhost:8080", "[::1]:8080"}
    assert not admitted or set(map(str, headers.get_all("Host"))) <= hosts


# Modules that lie in the folder

_CONSOLE = """
from invertwin.__main__ import main
sys.argv = ["invertwin", "simulate", "run.toml", "-o", "out"]
main()
"""
_WORKERS = """
from invertwin.runtime.engines import run_jobs
names = ("h5py", "invertwin.viewer", "invertwin.cli.app", "matplotlib.pyplot", "scipy.optimize")
for _ in run_jobs(exec, [f"import {name}" for name in names], workers=2, engine="processes"):
    pass
"""
_READER = """
from invertwin.capture import Capture
Capture.load("data/beat.nc")
"""


def _folders() -> list[Files]:
    """What is run, and the files that it reads."""
    found = [
        {"run.py": _CONSOLE.encode(), "run.toml": _SIMULATED.encode()},
        {"run.py": _WORKERS.encode()},
        {"run.py": _READER.encode(), "data/beat.nc": _captures()[0]["beat.nc"]},
    ]
    if importlib.util.find_spec("ray") is not None:
        found.append({"run.py": _WORKERS.replace('"processes"', '"ray"').encode()})
    return found


def _run_in_folder(path: Path) -> None:
    """Run as the console script does: without the working folder on the import path."""
    known = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    # Not -P, which its children would inherit.
    call = [sys.executable, "-c", f"import sys\ndel sys.path[0]\n{path.read_text()}"]
    ended = subprocess.run(call, cwd=path.parent, env=known, capture_output=True, text=True)
    ran = [str(file.relative_to(path.parent)) for file in path.parent.rglob(f"*{RAN}")]
    assert not ran, f"imported {ran}"
    assert ended.returncode == 0, ended.stderr[-300:]


# Signatures, and bags of ROS

_ONE_PORT = b"""! by hand
# GHz S RI R 50
3 0.3 -0.4
4 0.2 -0.1
"""
_TWO_PORTS = b"""# MHz S DB R 75
100 -6.0206 0 -20 90 -40 180 0 -90   ! S11 S21 S12 S22
200 -6.0206 0 -20 90
    -40 180 0 -90
50 1.0 0.5 20 0.3
"""
_VERSION_2 = b"""[Version] 2.0
# GHz S RI R 50
[Number of Ports] 2
[Two-Port Data Order] 12_21
[Number of Frequencies] 2
[Reference]
50 50
[Network Data]
1 0.5 0 0.01 0 0 0.1 0.4 0
2 0.5 0 0.01 0 0 0.1 0.4 0
[End]
"""


def _signatures() -> list[Files]:
    return [
        {"plate.txt": b"1e9 90.0 0.0 -3.5\n1e9 90.0 45.0 -20.0\n"},
        {"horn.s1p": _ONE_PORT},
        {"horn.s2p": _TWO_PORTS},
        {"pair.s2p": _VERSION_2},
    ]


def _read_signature(path: Path) -> None:
    (load_rcs if path.suffix == ".txt" else load_touchstone)(path)


def _bags() -> list[Files]:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    kinds, kind = store.types, "geometry_msgs/msg/PointStamped"

    def write(folder: Path) -> str:
        with Writer(folder / "drive.bag") as out:
            connection = out.add_connection("/p", kind, typestore=store)
            for n in range(3):
                stamp = kinds["builtin_interfaces/msg/Time"](sec=n, nanosec=5)
                header = kinds["std_msgs/msg/Header"](seq=n, stamp=stamp, frame_id="r")
                point = kinds["geometry_msgs/msg/Point"](x=1.0 * n, y=2.0, z=3.0)
                raw = store.serialize_ros1(kinds[kind](header=header, point=point), kind)
                out.write(connection, n, raw)
        return "drive.bag"

    return _written(write)


def _read_bag(path: Path) -> None:
    read_track(path, "/p")
    read_topic(path, "/p", "point.x")


FORMATS: dict[str, Format] = {
    "run_file": Format(_runs, _read_run, ("words", "values", "values", "special")),
    "old_run_file": Format(_old_runs, convert_file, ("words", "values", "values", "special")),
    "mesh": Format(_meshes, _read_mesh),
    "capture": Format(
        _captures, _read_capture, ("bytes", "values", "values", "values", "special"), short=30
    ),
    "npz": Format(_npz, _read_npz, ("bytes", "values", "special")),
    "mat": Format(
        _mats, _read_arrays, ("bytes", "values", "values", "values", "special"), short=30
    ),
    "sweeps": Format(_sweeps, _read_sweeps),
    "dca1000": Format(_boards, _read_board),
    "channels": Format(_channels, ChannelCalibration.load),
    "checkpoint": Format(_checkpoints, _read_checkpoint, ("bytes", "values", "values", "special")),
    "view": Format(_views, _read_view, ("bytes", "values", "values", "special")),
    "data_set": Format(_data_sets, _read_data_set, ("bytes", "values", "values", "special")),
    "signature": Format(_signatures, _read_signature),
    "bag": Format(_bags, _read_bag, ("bytes", "values", "special")),
    "message": Format(_messages, _read_message, ("bytes", "words", "values")),
    "manifest": Format(_manifests, _read_manifest, intact=("victim", "notes.txt")),
    "estimate": Format(_estimates, _read_estimate, ("numbers",), short=20),
    "planted": Format(_folders, _run_in_folder, ("planted",), short=4),
}
