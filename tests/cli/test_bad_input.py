"""Bad input through the command line: one line, exit code 2, nothing on disk touched."""

import numpy as np
import pytest
import torch

from cli.small import BEHIND, MATERIAL, RUN, call, read_metrics
from invertwin.capture import Capture
from invertwin.capture.readers.radar_fields import write_dataset
from invertwin.cli.run_file import load_run
from invertwin.cli.schema import build
from invertwin.scene import Mesh, plate
from invertwin.scene.files import save_mesh
from invertwin.storage.folders import MANIFEST
from invertwin.storage.run_folder import open_run

NAN_VERTEX = """ply
format ascii 1.0
element vertex 3
property double x
property double y
property double z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
nan 0 0
0 1 0
3 0 1 2
"""
MEASURED = (RUN[: RUN.index("[radar]")] + RUN[RUN.index("[grid]") :]).replace(
    'kind = "simulated"\ndepth = 1\npoints_per_m2 = 2e3\nsnr_db = 20.0',
    'kind = "capture"\nfile = "data.nc"',
)
RAIL = MEASURED.replace('"capture"\nfile = "data.nc"', '"rail_sar"\nfolder = "rail_sar"')
SOUGHT = 'kind = "translation"\nobject = "plate"'


def fitted(values: str) -> str:
    return RUN.replace(SOUGHT, f'kind = "material"\nobject = "plate"\nvalues = {values}')


def car(file: str) -> str:
    return RUN + f'[scene.car]\nfile = "{file}"\n' + MATERIAL


@pytest.fixture
def folder(run_file, monkeypatch):
    """Broken files of every kind, and results of an earlier run."""
    folder = run_file.parent
    monkeypatch.setenv("INVERTWIN_DATA", str(folder / "nowhere"))
    (folder / "empty.obj").write_text("# nothing\n")
    (folder / "nan.ply").write_text(NAN_VERTEX)
    save_mesh(folder / "whole.ply", plate(1.0, 1.0, 4))
    (folder / "cut.ply").write_bytes((folder / "whole.ply").read_bytes()[:300])
    (folder / "noise.stl").write_bytes(b"\x00\xff" * 100)
    table = load_run(run_file).radar
    assert table is not None
    radar = build.radar(table)
    beat = torch.randn(2, 1, 24, 64, dtype=torch.complex128, generator=torch.Generator())
    capture = Capture.from_beat(beat, radar)
    capture.save(folder / "whole.nc")
    (folder / "cut.nc").write_bytes((folder / "whole.nc").read_bytes()[:-4000])
    write_dataset(capture.dataset.isel(sample=slice(10)), folder / "short.nc")
    write_dataset(capture.dataset.transpose("sample", ...), folder / "turned.nc")
    spoiled = capture.dataset.copy(deep=True)
    spoiled["beat"].values[0, 0, 0, 0] = np.nan
    write_dataset(spoiled, folder / "nan.nc")
    with open_run(folder / "full", {"bad": "seed = 1"}) as done:
        done.write_text("metrics.json", "{}")
    return folder


@pytest.mark.parametrize(
    ("text", "said"),
    [
        pytest.param(car("none.obj"), ["scene.car: ", "none.obj", "check the path"], id="no mesh"),
        pytest.param(car("empty.obj"), ["scene.car: ", "empty.obj"], id="empty mesh"),
        pytest.param(car("nan.ply"), ["scene.car: ", "nan.ply", "NaN"], id="NaN vertex"),
        pytest.param(car("cut.ply"), ["scene.car: ", "cut.ply"], id="truncated mesh"),
        pytest.param(car("noise.stl"), ["scene.car: ", "noise.stl"], id="mesh of noise"),
        pytest.param(MEASURED, ["data.file: ", "data.nc", "check the path"], id="no capture"),
        pytest.param(
            MEASURED.replace("data.nc", "cut.nc"),
            ["data.file: ", "cut.nc", "truncated"],
            id="truncated capture",
        ),
        pytest.param(
            MEASURED.replace("data.nc", "small.toml"), ["data.file: ", "NetCDF"], id="no NetCDF"
        ),
        pytest.param(
            MEASURED.replace("data.nc", "short.nc"),
            ["data.file: ", "64 samples per ramp", "got 10"],
            id="wrong shape",
        ),
        pytest.param(
            MEASURED.replace("data.nc", "turned.nc"),
            ["data.file: ", "dimensions ('frame', 'tx', 'rx', 'sample')"],
            id="wrong order",
        ),
        pytest.param(
            MEASURED.replace("data.nc", "nan.nc"), ["data.file: ", "NaN"], id="NaN in capture"
        ),
        pytest.param(
            RAIL,
            ["data.folder: ", "bwsi_rail_trial6.npz", "github.com/jjimmykang", "INVERTWIN_DATA"],
            id="no recording",
        ),
        pytest.param(
            RUN.replace("range_min", "range_mni"), ["grid.range_mni: ", "`range_min`"], id="key"
        ),
        pytest.param(
            RUN.replace("76e9", "76"), ["radar.waveform: ", "76e9"], id="GHz instead of Hz"
        ),
        pytest.param(
            RUN.replace("5e-5", "50"), ["radar.waveform: ", "seconds", "50e-6"], id="µs not s"
        ),
        pytest.param(
            RUN.replace("range_max = 1.8", "range_max = 1800"),
            ["grid.range_max: ", "give metres"],
            id="mm not m",
        ),
        pytest.param(BEHIND, ["map with power", "check the grid"], id="behind the radar"),
        pytest.param(
            fitted('["diffuse"]'),
            ["parameters[0].values, material of plate: ", "got 1", "start away from the end"],
            id="diffuse = 1",
        ),
        pytest.param(
            fitted('["conductivity"]'),
            ["parameters[0].values, material of plate: ", "got 0", "start away from the end"],
            id="conductivity = 0",
        ),
        pytest.param(
            RUN + '[loss]\nkind = "likelihood"\nbackground = "static"\n',
            ["loss: ", "expected one level as the background"],
            id="loss of two minds",
        ),
        pytest.param(
            RUN + '[scene_file]\nfile = "room.xml"\n', ["scene_file: ", "room.xml"], id="no XML"
        ),
    ],
)
def test_one_line_code_2_and_results_untouched(folder, monkeypatch, capfd, text, said):
    (folder / "bad.toml").write_text(text)
    assert call(monkeypatch, "reconstruct", "bad.toml", "-o", "full", "--overwrite") == 2
    error = capfd.readouterr().err
    for part in said:
        assert part in error
    assert error.startswith("invertwin: ")
    assert "expected" in error
    assert error.count("\n") == 1
    names = {path.name for path in (folder / "full").iterdir()}
    assert names == {MANIFEST, "metrics.json", "run.toml"}
    assert (folder / "full" / "metrics.json").read_text() == "{}"


def shapes() -> dict[str, Mesh]:
    """Meshes that are odd but mean something, all in the y-z plane or near it."""
    corners = [[0.0, -0.2, -0.2], [0.0, 0.2, -0.2], [0.0, 0.0, 0.2], [-0.2, 0.0, 0.0]]
    corners.append([0.2, 0.0, 0.0])
    fins = [[0, 2, 1], [0, 1, 3], [0, 1, 4]]  # three faces on one edge
    return {
        "open": Mesh(torch.tensor(corners).double(), torch.tensor([[0, 2, 1]])),
        "non-manifold": Mesh(torch.tensor(corners).double(), torch.tensor(fins)),
        "zero area": Mesh(torch.tensor(corners).double(), torch.tensor([[0, 2, 1], [0, 0, 1]])),
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", shapes())
def test_odd_meshes_are_fitted(run_file, monkeypatch, name):
    save_mesh(run_file.with_name("odd.ply"), shapes()[name])
    start, stop = RUN.index("[scene.plate]"), RUN.index("[scene.wall]")
    placed = f"position = [1.2, 0.0, 0.0]\n{MATERIAL.replace('perfect_conductor', 'ROUGH')}"
    placed = placed.replace('kind = "ROUGH"', 'kind = "rough_dielectric", permittivity = 4.0')
    text = RUN[:start] + f'[scene.plate]\nfile = "odd.ply"\n{placed}\n' + RUN[stop:]
    run_file.write_text(text)
    assert call(monkeypatch, "reconstruct", run_file) == 0
    metrics = read_metrics(run_file.parent / "out" / "small")
    moved = np.array(metrics["parameters"]["plate.translation"])
    assert np.isfinite(moved).all()
    assert (moved != 0).all()
    assert metrics["loss"] < 1


@pytest.mark.slow
def test_start_out_of_sight_ends_without_an_exception(run_file, monkeypatch):
    # The data hold the wall alone; the plate stands where the grid does not reach.
    text = RUN.replace("[1.2, 0.02, 0.01]", "[9.0, 0.0, 0.0]").replace("steps = 8", "steps = 2")
    text = text.replace("position = [1.2, 0.0, 0.0]", "position = [9.0, 0.0, 0.0]")
    run_file.write_text(text)
    assert call(monkeypatch, "reconstruct", run_file) == 0
    metrics = read_metrics(run_file.parent / "out" / "small")
    assert np.isfinite(metrics["loss"])
    assert np.allclose(metrics["parameters"]["plate.translation"], 0, atol=0.05)


@pytest.mark.slow
def test_isotropic_antenna_sees_behind_itself(run_file, monkeypatch):
    text = BEHIND.replace('kind = "cosine", exponent = 1.0', 'kind = "isotropic"')
    run_file.write_text(text.replace("[1.2, 0.02, 0.01]", "[-1.2, 0.02, 0.01]"))
    assert call(monkeypatch, "simulate", run_file) == 0
    metrics = read_metrics(run_file.parent / "out" / "small")
    assert metrics["peak_range_m"] == pytest.approx(1.2, abs=0.5)


@pytest.mark.slow
def test_parameters_that_are_not_numbers_end_as_diverged(run_file, monkeypatch):
    run_file.write_text(RUN + "[optimizer]\nrate = 1e30\n")
    assert call(monkeypatch, "reconstruct", run_file) == 0
    metrics = read_metrics(run_file.parent / "out" / "small")
    assert metrics["status"] == "diverged"
    assert metrics["position_error_m"] == pytest.approx(metrics["start_distance_m"])
    assert metrics["parameters"]["plate.translation"] == [0.0, 0.0, 0.0]
