"""Data sets: the same bytes whoever makes them, labels that are true, folders that are safe."""

import json
import re
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

import pytest
import torch

import invertwin
from cli.small import call, read_metrics
from invertwin.capture.readers import described_arrays
from invertwin.cli.commands.dataset import make_sample_run, make_shard
from invertwin.cli.exact_signals import warn_if_aliased
from invertwin.cli.run_file import load_run, to_toml, validate_run
from invertwin.cli.schema import build
from invertwin.cli.schema.motion_tables import build_moving_scene
from invertwin.cli.schema.shape_tables import joint_positions
from invertwin.cli.schema.variation import parse_key_path, set_values
from invertwin.datasets import SampleDataset, object_labels
from invertwin.datasets.shards import locate_members
from invertwin.errors import InputError, PhysicsWarning
from invertwin.radar import Chirps
from invertwin.runtime.engines import run_jobs

ANYWHERE = Path("rooms.toml")
RUN = """
task = "dataset"
frame = 2
seed = 1

[scene.ball]
shape = "sphere"
radius = 0.2
position = [1.6, 0.0, 0.0]
velocity = [1.0, 0.0, 0.0]
material = { kind = "rough_dielectric", permittivity = 4.0 }

[scene.wall]
shape = "plate"
width = 2.0
height = 2.0
position = [2.4, 0.0, 0.0]
material = { kind = "rough_dielectric", permittivity = 4.0 }

[radar]
waveform = { kind = "fmcw", start_frequency = 77e9, bandwidth = 1e9, duration = 5e-5, samples = 64 }
transmitters = { kind = "positions", positions = [[0.0, 0.0, 0.0]] }
receivers = { kind = "linear", count = 4, spacing = 1.92e-3 }
positions = [[0.0, 0.0, 0.0]]

[grid]
range_min = 0.5
range_max = 3.5
u_max = 0.8

[chirps]
count = 4
interval = 6e-5

[data]
kind = "simulated"
depth = 1
points_per_m2 = 200.0
snr_db = 20.0

[dataset]
samples = 5
shard = 2
signals = ["raw", "map"]
classes = { ball = "thing" }
masks = true

[[vary]]
key = "scene.ball.position"
kind = "uniform"
low = [1.0, -0.3, 0.0]
high = [2.0, 0.3, 0.0]

[[vary]]
key = ["scene.ball.material.permittivity", "scene.wall.material.permittivity"]
kind = "log_uniform"
low = 2.0
high = 8.0

[[vary]]
key = "scene.wall"
kind = "presence"

[[vary]]
key = "data.snr_db"
kind = "choice"
values = [10.0, 20.0]
"""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The data set by one worker, and the folder with its run file."""
    folder = tmp_path_factory.mktemp("dataset")
    (folder / "rooms.toml").write_text(RUN)
    return invertwin.dataset(folder / "rooms.toml", folder / "whole"), folder


def shards(folder):
    return {file.name: file.read_bytes() for file in folder.rglob("*.tar")}


@pytest.mark.slow
def test_two_workers_make_the_same_bytes(whole, monkeypatch, capsys):
    _, folder = whole
    file, out = folder / "rooms.toml", folder / "two"
    assert call(monkeypatch, "dataset", file, "-o", out, "--workers", "2") == 0
    assert shards(out) == shards(folder / "whole")
    assert len(shards(out)) == 3
    manifests = [(folder / name / "manifest.json").read_text() for name in ("two", "whole")]
    assert manifests[0] == manifests[1]
    metrics = read_metrics(out)
    assert (metrics["dataset_samples"], metrics["shards"]) == (5, 3)
    assert metrics["dataset_bytes"] == sum(map(len, shards(out).values()))
    said = capsys.readouterr().out
    assert metrics["answer"] == "5 samples (beat, map, masks) in 3 shards"
    assert metrics["answer"] in said
    assert "report.html" in said
    page = (out / "report.html").read_text()
    assert page.index("The first sample") < page.index("samples per second")


def test_a_shard_does_not_depend_on_what_was_made_before(whole):
    _, folder = whole
    text = to_toml(load_run(folder / "rooms.toml"))
    assert make_shard((text, 4, 1)) == shards(folder / "whole")["shard-000002.tar"]


@pytest.mark.slow
def test_two_nodes_of_a_ray_cluster_make_the_same_bytes(whole, monkeypatch):
    """Runs where the extra `ray` is installed."""
    ray = pytest.importorskip("ray")
    monkeypatch.setenv("OMP_NUM_THREADS", "2")  # what nodes inherit, and workers must not
    from ray.cluster_utils import Cluster  # pyright: ignore[reportMissingImports]

    _, folder = whole
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        cluster.add_node(num_cpus=1)
        ray.init(address=cluster.address, log_to_driver=False)
        invertwin.dataset(folder / "rooms.toml", folder / "ray", engine="ray")
        nodes = {node for _, node in run_jobs(node_of, [0, 1], engine="ray")}
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert len(nodes) == 2
    assert shards(folder / "ray") == shards(folder / "whole")


def node_of(_: int) -> str:
    """The node of a cluster that works on this."""
    import ray  # pyright: ignore[reportMissingImports]

    time.sleep(2.0)  # so long that another node takes the other piece
    return ray.get_runtime_context().get_node_id()


@pytest.mark.slow
def test_parts_are_parts_of_the_whole(whole, monkeypatch):
    _, folder = whole
    arguments = ["dataset", folder / "rooms.toml", "-o", folder / "parts", "--shard", "2/2"]
    assert call(monkeypatch, *arguments) == 0
    made = shards(folder / "parts" / "part_2_of_2")
    assert made == {"shard-000001.tar": shards(folder / "whole")["shard-000001.tar"]}
    assert [sample["index"] for sample in SampleDataset(folder / "parts")] == [2, 3]


@pytest.mark.slow
def test_a_run_that_is_killed_goes_on_to_the_same_bytes(whole, monkeypatch):
    _, folder = whole
    out = folder / "killed"
    # Dies as kill -9 does, once the first shard is written.
    script = f"""
import os, sys
from invertwin.storage.run_folder import RunFolder
from invertwin.cli import app
write = RunFolder.write_json
def last(self, name, value):
    write(self, name, value)
    if name.startswith("parts/"):
        os.kill(os.getpid(), 9)
RunFolder.write_json = last
sys.argv = ["invertwin", "dataset", {str(folder / "rooms.toml")!r}, "-o", {str(out)!r},
            "--workers", "1"]
app.main()
"""
    killed = subprocess.run([sys.executable, "-c", script], capture_output=True)
    assert killed.returncode == -9
    assert not list(out.glob("*.tar"))
    file = folder / "rooms.toml"
    assert call(monkeypatch, "dataset", file, "-o", out, "--resume", "--workers", "1") == 0
    assert shards(out) == shards(folder / "whole")
    assert not (out / "unfinished").exists()
    assert call(monkeypatch, "dataset", file, "-o", out) == 2  # results are there
    assert call(monkeypatch, "dataset", file, "-o", out, "--resume") == 0  # was complete


def test_a_foreign_folder_is_refused_and_left_alone(whole, tmp_path, monkeypatch, capsys):
    _, folder = whole
    theirs = tmp_path / "shard-000000.tar"
    theirs.write_text("mine")
    assert call(monkeypatch, "dataset", folder / "rooms.toml", "-o", tmp_path, "--overwrite") == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "shard-000000.tar" in said
    assert [file.name for file in tmp_path.iterdir()] == ["shard-000000.tar"]
    assert theirs.read_text() == "mine"


def test_samples_hold_signals_and_true_labels(whole):
    found, _ = whole
    first = found.manifest.arrays
    assert first["map"].dims == ["frame", "velocity", "range", "u", "v"]
    assert first["beat"].dims == ["frame", "chirp", "tx", "rx", "sample"]
    present = set()
    for sample in found:
        labels, own = sample["labels"], tomllib.loads(sample["run"])
        ball = labels["objects"][0]
        assert sample["beat"].shape == (1, 4, 1, 4, 64)
        assert sample["beat"].dtype == torch.complex64
        assert sample["map"].shape[:2] == (1, 4)
        assert (ball["name"], ball["class"]) == ("ball", "thing")
        assert [row[3] for row in ball["pose"][:3]] == own["scene"]["ball"]["position"]
        assert ball["velocity"] == [1.0, 0.0, 0.0]
        # A little less than half of a ball is seen: cos of the cone that touches it.
        x, y, z = own["scene"]["ball"]["position"]
        share = 0.5 * (1 - 0.2 / (x * x + y * y + z * z) ** 0.5)
        assert ball["seen"][0] == pytest.approx(share, abs=0.02)
        count = sum(row["triangles"]["count"] for row in labels["objects"])
        assert sample["masks"].shape == (1, count)
        # Label and map agree: the strongest echo is that of the front half of the ball.
        if len(labels["objects"]) == 1:
            run = validate_run(own, ANYWHERE)
            ranges = build.grid(run.grid, build.radar(run.radar)).ranges
            peak = float(ranges[sample["map"].amax((0, 1, 3, 4)).argmax()])
            middle = (x * x + y * y + z * z) ** 0.5
            assert middle - 0.2 - 0.1 < peak < middle + 0.1
        present.add(len(labels["objects"]))
        values = {table["material"]["permittivity"] for table in own["scene"].values()}
        assert len(values) == 1  # one draw for two keys
    assert present == {1, 2}


def test_samples_hold_micro_doppler(tmp_path):
    """The ball recedes with 1 m/s along x: its range rate is that times the cosine to x."""
    text = RUN[: RUN.index("[dataset]")].replace("count = 4", "count = 64")
    text = text.replace("interval = 6e-5", "interval = 4e-4")
    (tmp_path / "ball.toml").write_text(
        text + '[dataset]\nsamples = 1\nsignals = ["micro_doppler"]\n'
    )
    found = invertwin.dataset(tmp_path / "ball.toml", tmp_path / "out")
    assert found.manifest.arrays["micro_doppler"].dims == ["frame", "time", "velocity"]
    power = found[0]["micro_doppler"]
    assert power.shape == (1, 25, 16)
    limit = 299_792_458 / 77.5e9 / (4 * 4e-4)  # the last bin is one below it
    rates = torch.linspace(-limit, limit, 17)[:-1]
    assert rates[power[0].mean(0).argmax()] == pytest.approx(1.0, abs=limit / 8)


def test_what_moves_beyond_the_limit_of_range_rates_is_told(tmp_path, monkeypatch, capsys):
    run = validate_run(tomllib.loads(RUN), ANYWHERE)
    moving, radar = build_moving_scene(run, build.true_scene(run)), build.radar(run.radar)
    with pytest.warns(PhysicsWarning, match=r"up to 1.00 m/s, beyond 0.97 m/s, and appears"):
        warn_if_aliased(moving, radar, Chirps(64, 1e-3))
    warn_if_aliased(moving, radar, Chirps(64, 0.9e-3))  # no warning: ±1.07 m/s


def test_a_sample_is_simulated_again_from_its_own_run_file(whole, tmp_path, monkeypatch):
    found, _ = whole
    (tmp_path / "again.toml").write_text(found[3]["run"])
    out = tmp_path / "again"
    assert call(monkeypatch, "simulate", tmp_path / "again.toml", "-o", out) == 0
    beat = described_arrays.read_chirps(out / "chirps.toml").samples
    recorded = found[3]["beat"].to(torch.complex128)
    again = torch.as_tensor(beat).reshape(recorded.shape)
    assert (again - recorded).abs().max() < 1e-6 * recorded.abs().max()


def test_check_counts_all_samples(whole, monkeypatch, capsys):
    _, folder = whole
    assert call(monkeypatch, "check", folder / "rooms.toml") == 0
    (few,) = re.findall(r"and ([0-9.e+]+) paths", capsys.readouterr().out)
    (folder / "more.toml").write_text(RUN.replace("samples = 5", "samples = 500"))
    assert call(monkeypatch, "check", folder / "more.toml") == 0
    (many,) = re.findall(r"and ([0-9.e+]+) paths", capsys.readouterr().out)
    assert float(many) == pytest.approx(100 * float(few), rel=0.1)


def test_draws_depend_on_seed_and_index_only():
    run = validate_run(tomllib.loads(RUN), ANYWHERE)
    longer = validate_run(tomllib.loads(RUN.replace("samples = 5", "samples = 500")), ANYWHERE)
    assert to_toml(make_sample_run(run, 4)) == to_toml(make_sample_run(longer, 4))
    places = [make_sample_run(longer, k).scene["ball"].position for k in range(40)]
    assert len({tuple(place) for place in places}) == 40
    other = run.model_copy(update={"seed": 6})
    assert (
        make_sample_run(other, 4).scene["ball"].position
        != make_sample_run(run, 4).scene["ball"].position
    )
    assert make_sample_run(run, 4).seed not in (run.seed, make_sample_run(run, 3).seed)
    # One more table at the end changes nothing of those before it.
    more = (
        RUN
        + '[[vary]]\nkey = "data.points_per_m2"\nkind = "normal"\nmean = 200.0\ndeviation = 1.0\n'
    )
    assert make_sample_run(validate_run(tomllib.loads(more), ANYWHERE), 4).scene == (
        make_sample_run(run, 4).scene
    )


def test_joints_of_a_body_are_where_its_skin_is():
    raw = tomllib.loads(RUN)
    raw["scene"] = {
        "anna": {
            "shape": "body",
            "spacing": 0.05,
            "position": [3.0, 0.5, 0.0],
            "rotation_deg": [0.0, 0.0, 90.0],
            "angles_deg": {"right_elbow": [0.0, 0.0, 90.0]},
            "material": {"kind": "rough_dielectric", "permittivity": 20.0},
        }
    }
    del raw["vary"], raw["dataset"]["classes"]
    run = validate_run(raw, ANYWHERE)
    scene = build.true_scene(run)
    joints = joint_positions(run.scene["anna"], scene["anna"])
    assert joints["pelvis"].tolist() == pytest.approx([3.0, 0.5, 0.0])
    # Turned by 90° about z, what was at +y is now at −x.
    assert joints["right_elbow"].tolist() == pytest.approx([3.0 - 0.47, 0.5, 0.45], abs=1e-6)
    skin = scene["anna"].vertices
    for place in joints.values():
        assert (skin - place).norm(dim=1).min() < 0.16


def varied(**table):
    raw = tomllib.loads(RUN)
    raw["vary"] = [table]
    return raw


@pytest.mark.parametrize(
    ("raw", "said"),
    [
        (
            varied(key="scene.ball.positon[0]", kind="uniform", low=0.0, high=1.0),
            r"^vary\[0\].key: scene.ball.positon\[0\]: .*did you mean `position`\?",
        ),
        (
            varied(key="scene.ball.radiuss", kind="uniform", low=0.1, high=1.0),
            r"^vary\[0\].scene.ball.radiuss: expected one of the keys .*did you mean `radius`\?",
        ),
        (
            varied(key="scene.bal.radius", kind="uniform", low=0.1, high=1.0),
            r"\(ball, wall\), got \"bal\"; did you mean `ball`\?",
        ),
        (
            varied(key="scene.ball.position[3]", kind="uniform", low=0.1, high=1.0),
            r"an entry \[3\], got a list of 3",
        ),
        (
            varied(key="scene.ball.rotation_deg[1]", kind="uniform", low=0.1, high=1.0),
            'got "rotation_deg"; add it',
        ),
        (
            varied(key="scene.ball.radius", kind="uniform", low=-0.1, high=1.0),
            r"^vary\[0\].scene.ball.radius: expected greater than 0, got -0.1",
        ),
        (
            varied(key="scene.ball.position", kind="normal", mean=[0.0, 1.0], deviation=0.1),
            r"^vary\[0\].scene.ball.position: expected at least 3 items",
        ),
        (
            varied(key="scene.ball.radius", kind="unifrom", low=0.1, high=1.0),
            "did you mean `uniform`",
        ),
        (varied(key="seed", kind="integer", low=0, high=9), r"^vary\[0\].*: .*got \"seed\""),
        (varied(key=3, kind="presence"), r"^vary\[0\].key: expected a text in quotes, got 3"),
        (varied(key=[], kind="presence"), r"^vary\[0\].key: expected at least 1 items"),
        (varied(key="scene..ball", kind="presence"), r"got \"scene..ball\""),
        (
            varied(key=["data.snr_db", "data.snr_db"], kind="integer", low=0, high=9),
            "every key once",
        ),
        (
            {**tomllib.loads(RUN), "dataset": {"samples": 2, "classes": {"bal": "x"}}},
            r"^dataset.classes.bal: .*did you mean `ball`",
        ),
        (
            {
                **{k: v for k, v in tomllib.loads(RUN).items() if k != "chirps"},
                "dataset": {"samples": 2, "signals": ["micro_doppler"]},
            },
            r"^dataset.signals: expected \[chirps\] with micro_doppler",
        ),
        (
            {**tomllib.loads(RUN), "dataset": {"samples": 2, "paths": True}},
            r"^dataset.paths: expected false with \[chirps\]",
        ),
        (
            {**tomllib.loads(RUN), "data": {"kind": "capture", "file": "a.nc"}},
            r"^data.kind: expected \"simulated\" with \[dataset\], got \"capture\"",
        ),
        (
            {**tomllib.loads(RUN), "observations": {"near": {"weight": 2.0}}},
            r"^observations: expected none with \[dataset\]",
        ),
        (
            {k: v for k, v in tomllib.loads(RUN).items() if k != "dataset"},
            r"^vary: expected a section \[dataset\]",
        ),
    ],
)
def test_what_is_wrong_is_told_before_any_work(raw, said):
    with pytest.raises(InputError) as found:
        validate_run(raw, ANYWHERE)
    message = str(found.value).removeprefix("rooms.toml: ")
    assert "\n" not in message
    assert re.search(said, message), message


@pytest.mark.parametrize("text", ["2", "a/b", "1/2/3", "0/2", "3/2"])
def test_shards_that_are_none_are_told(whole, monkeypatch, capsys, text):
    _, folder = whole
    out = folder / "none"
    assert call(monkeypatch, "dataset", folder / "rooms.toml", "-o", out, "--shard", text) == 2
    assert "i/n" in capsys.readouterr().err
    assert not list(folder.glob("none/**/*.tar"))


def test_names_with_dots_stand_in_quotes():
    assert parse_key_path('scene."a.b".position[0]') == ("scene", "a.b", "position", 0)
    assert parse_key_path("a[0][1]") == ("a", 0, 1)
    for path in ("", "a.", ".a", "a b", "a[x]", "a..b", "a[0]b"):
        assert parse_key_path(path) == (), path
    raw = {"a": [1, 2, 3], "b": {"c": 4}}
    gone = set_values(raw, [("a[0]", None), ("a[2]", None), ("b.c", None), ("b.d", 5)])
    assert gone == {"a": [2], "b": {"d": 5}}
    assert raw == {"a": [1, 2, 3], "b": {"c": 4}}


def test_paths_are_written_where_they_are_asked_for(tmp_path):
    text = RUN.replace("[chirps]\ncount = 4\ninterval = 6e-5\n", "")
    text = text.replace("velocity = [1.0, 0.0, 0.0]\n", "")
    text = text.replace("masks = true", "paths = true").replace("samples = 5", "samples = 1")
    run = validate_run(tomllib.loads(text), tmp_path / "run.toml")
    (tmp_path / "a.tar").write_bytes(make_shard((to_toml(run), 0, 1)))
    members = locate_members(tmp_path / "a.tar")[0]
    assert {name for name in members if name.startswith("paths")} == {
        f"paths_{name}.npy" for name in ("frame", "delay", "coefficient", "first", "last")
    }


ROOM = """
[room]
furniture = ["table", "chair_1", "sofa"]
materials = {}

[truth.sofa]
position = [3.0, -1.5, 0.0]

[[vary]]
key = ["room.width", "room.depth"]
kind = "uniform"
low = 4.5
high = 6.0

[[vary]]
key = "room.furniture[1]"
kind = "presence"

[[vary]]
key = "room.materials.floor"
kind = "choice"
values = [{ kind = "rough_dielectric", itu = "wood" }, { kind = "rough_conductor" }]

[[vary]]
key = "truth.sofa.position[0]"
kind = "uniform"
low = 1.5
high = 3.0
"""


def test_rooms_are_drawn_and_their_furniture_is_labelled():
    run = validate_run(tomllib.loads(RUN + ROOM), ANYWHERE)
    floors, counts = set(), set()
    for index in range(12):
        item: Any = make_sample_run(run, index)
        objects, made = labels_of(item), item.room
        floors.add(made.materials["floor"].kind)
        counts.add(len(made.furniture))
        assert ("chair_1" in objects) == (len(made.furniture) == 3)
        assert objects["ball"]["class"] == "thing"
        width, place = made.width, item.truth["sofa"].position[0]
        assert 4.5 <= width == made.depth <= 6.0
        left = objects["wall_left"]["oriented_box"]["center"]
        assert left == pytest.approx([width / 2, width / 2, 1.3])
        sofa = objects["sofa"]["oriented_box"]
        assert sofa["center"][0] == pytest.approx(place)
        assert 1.5 <= place <= 3.0
        assert sofa["size"] == pytest.approx([1.9, 0.85, 0.822], abs=0.01)
    assert floors == {"rough_dielectric", "rough_conductor"}
    assert counts == {2, 3}


def labels_of(run):
    scene = build.true_scene(run)
    seen = {name: torch.zeros(1, len(item.mesh.faces)) for name, item in scene.objects.items()}
    return {row["name"]: row for row in object_labels(scene, seen, {"ball": "thing"}, {})}


def test_json_of_labels_is_strict(whole):
    found, _ = whole
    assert json.dumps(found[0]["labels"], allow_nan=False)
