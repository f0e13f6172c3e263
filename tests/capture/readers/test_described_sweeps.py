"""Touchstone sweeps and phase histories as captures."""

import math
import re
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
import torch

from invertwin.capture import Capture, backproject, is_sweeps, read
from invertwin.capture.readers.described_sweeps import read_sweeps
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.radar import SteppedFrequency, range_profile
from invertwin.radar.waveform import PhysicsWarning

FREQUENCIES = 4e9 + 10e6 * np.arange(101)  # 15 m unambiguous, 0.15 m cells
TARGET, WALL = np.array([3.0, 0.3, 0.0]), np.array([6.0, -1.0, 0.5])
TX, RX = np.array([0.0, -0.1, 0.0]), np.array([0.0, 0.1, 0.0])
RAIL = [np.array([0.0, y, 0.0]) for y in np.linspace(-0.4, 0.4, 17)]


def response(place, *points, cables=0.0):
    """H = Σ a exp(−2πj f τ) of the points as two antennas see them."""
    found = np.zeros(len(FREQUENCIES), complex)
    for point in points:
        length = np.linalg.norm(point - place - TX) + np.linalg.norm(point - place - RX)
        delay = (length + 2 * cables) / SPEED_OF_LIGHT
        found += 1e-3 * np.exp(-2j * np.pi * FREQUENCIES * delay)
    return found


def touchstone(file, s21, frequencies=FREQUENCIES):
    """Writes two ports whose other parameters are something else, as S11, S21, S12, S22."""
    lines = ["# GHz S RI R 50"]
    for f, s in zip(frequencies, s21, strict=True):
        lines.append(f"{f / 1e9:.9f} 0.5 0.1 {s.real:.12e} {s.imag:.12e} 0.2 0.2 -0.4 0.3")
    file.write_text("\n".join(lines) + "\n")


DESCRIPTION = """\
frame = 2

[data]
files = "rail_*.s2p"

[sweep]
background = "empty.s2p"

[radar]
positions = "rail.csv"
look_at = [3.0, 0.0, 0.0]
tx_positions = [[0.0, -0.1, 0.0]]
rx_positions = [[0.0, 0.1, 0.0]]
"""


@pytest.fixture
def rail(tmp_path):
    """Sweeps along a rail that look ahead, of a wall behind a target; the wall alone, from one."""
    for number, place in enumerate(RAIL):
        touchstone(tmp_path / f"rail_{number:02d}.s2p", response(place, TARGET) + 5e-3)
    touchstone(tmp_path / "empty.s2p", np.full(len(FREQUENCIES), 5e-3 + 0j))
    lines = ["file,x,y,z", *(f"{n},{x},{y},{z}" for n, (x, y, z) in enumerate(RAIL))]
    (tmp_path / "rail.csv").write_text("\n".join(lines) + "\n")
    path = tmp_path / "rail.toml"
    path.write_text(DESCRIPTION.replace("look_at = [3.0, 0.0, 0.0]\n", ""))
    return path


def test_one_file_is_one_frame_at_the_origin(tmp_path):
    touchstone(tmp_path / "one.S2P", response(np.zeros(3), TARGET))
    assert is_sweeps(tmp_path / "one.S2P")
    capture = read(tmp_path / "one.S2P")
    assert isinstance(capture, Capture)
    radar = capture.radar()
    assert radar.positions.tolist() == [[0.0, 0.0, 0.0]]
    waveform = radar.waveform
    assert isinstance(waveform, SteppedFrequency)
    assert waveform.start_frequency == pytest.approx(4e9)
    assert waveform.step == pytest.approx(10e6)
    assert waveform.samples == 101
    grid = radar.grid(1.0, 6.0, oversample=8)
    shown = range_profile(capture.beat, radar, grid)[0, 0, 0].abs()
    length = np.linalg.norm(TARGET - TX) + np.linalg.norm(TARGET - RX)
    assert float(grid.ranges[shown.argmax()]) == pytest.approx(length / 2, abs=0.01)
    assert float(shown.max()) == pytest.approx(1e-3, rel=0.01)


def test_one_port_is_a_reflection(tmp_path):
    (tmp_path / "one.s1p").write_text("# MHz S MA\n100 0.5 90\n110 0.5 45\n120 0.5 0\n")
    beat = read_sweeps(tmp_path / "one.s1p").beat[0, 0, 0]
    assert beat.tolist() == pytest.approx([-0.5j, 0.5 * np.exp(-0.25j * np.pi), 0.5])


def test_a_rail_of_sweeps_images_the_target(rail):
    """With the background off and the antennas where they were: brightest at the target."""
    capture = read_sweeps(rail)
    radar = capture.radar()
    assert radar.shape == (17, 1, 1)
    assert torch.allclose(radar.positions, torch.tensor(np.array(RAIL)))
    x, y = torch.meshgrid(
        torch.linspace(2, 5, 61).double(), torch.linspace(-1, 1, 81).double(), indexing="ij"
    )
    points = torch.stack([x, y, 0 * x], dim=-1)
    image = backproject(capture, points).abs()
    found = points.flatten(0, 1)[image.argmax()]
    assert (found - torch.tensor(TARGET)).norm() < 0.03
    assert float(image.max()) == pytest.approx(1e-3, rel=0.02)


def test_a_background_is_subtracted(rail):
    with_it = read_sweeps(rail).beat
    rail.write_text(rail.read_text().replace('background = "empty.s2p"', ""))
    without = read_sweeps(rail).beat
    assert torch.allclose(without - with_it, torch.full_like(with_it, 5e-3), atol=1e-9)


def test_parameters_are_named_by_ports(rail):
    rail.write_text(rail.read_text().replace("[sweep]", '[sweep]\nparameter = "S11"'))
    beat = read_sweeps(rail).beat  # the same with and without a target
    assert beat.abs().max() < 1e-12
    rail.write_text(rail.read_text().replace("S11", "S31"))
    with pytest.raises(InputError, match=r"such as S11 of the 2 ports of rail_00.s2p, got 'S31'"):
        read_sweeps(rail)


def test_boresight_is_turned_to_a_point(rail):
    rail.write_text(DESCRIPTION)
    radar = read_sweeps(rail).radar()
    assert radar.rotations is not None
    toward = torch.tensor([3.0, 0.0, 0.0]) - radar.positions
    assert torch.allclose(
        radar.rotations[:, :, 0], toward / toward.norm(dim=1, keepdim=True), atol=1e-9
    )


def test_an_old_description_is_turned(rail):
    """Without a frame x is left, y up, z ahead, in the description and in the file it names."""
    rail.write_text(DESCRIPTION.replace("[radar]", "[radar]\nrange_center = [4.0, 0.2, 0.1]"))
    new = read_sweeps(rail).radar()
    old = """\
positions = "rail.csv"
range_center = [0.2, 0.1, 4.0]
look_at = [0.0, 0.0, 3.0]
tx_positions = [[-0.1, 0.0, 0.0]]
rx_positions = [[0.1, 0.0, 0.0]]
"""
    rail.write_text(
        DESCRIPTION.partition("[radar]\n")[0].removeprefix("frame = 2\n") + "[radar]\n" + old
    )
    lines = ["z,x,y", *(f"{x},{y},{z}" for x, y, z in RAIL)]
    (rail.parent / "rail.csv").write_text("\n".join(lines) + "\n")
    with pytest.warns(PhysicsWarning, match="look_at, positions, range_center, rx_positions"):
        found = read_sweeps(rail).radar()
    for name in ("positions", "rotations", "origins"):
        assert torch.equal(getattr(found, name), getattr(new, name)), name
    assert torch.equal(found.transmitters.positions, new.transmitters.positions)
    assert torch.equal(found.receivers.positions, new.receivers.positions)
    assert found.receivers.positions.tolist() == [[0.0, 0.1, 0.0]]


def test_cables_are_an_origin(tmp_path):
    """0.45 m of cable more than the calibration knows, each way."""
    touchstone(tmp_path / "one.s2p", response(np.zeros(3), TARGET, cables=0.45))
    (tmp_path / "one.toml").write_text(
        'frame = 2\n[data]\nfile = "one.s2p"\n[sweep]\n[radar]\nrange_origin = -0.45\n'
        "tx_positions = [[0, -0.1, 0]]\nrx_positions = [[0, 0.1, 0]]\n"
    )
    capture = read_sweeps(tmp_path / "one.toml")
    at = torch.tensor([[3.0, 0.3, 0.0], [3.45, 0.3, 0.0]], dtype=torch.float64)
    image = backproject(capture, at)
    assert abs(image[0] - 1e-3) < 3e-5
    assert abs(image[1]) < 1e-4


@pytest.mark.parametrize(
    ("frequencies", "match"),
    [
        (np.geomspace(4e9, 5e9, 101), "equally spaced frequencies, got steps from"),
        (FREQUENCIES[:1], "at least 2 frequencies, got 1"),
    ],
)
def test_other_sweeps_are_refused(tmp_path, frequencies, match):
    touchstone(tmp_path / "one.s2p", np.ones(len(frequencies)), frequencies)
    with pytest.raises(InputError, match=match):
        read_sweeps(tmp_path / "one.s2p")


@pytest.mark.parametrize("order", ["falling", "shuffled"])
def test_frequencies_in_another_order_are_sorted(tmp_path, order):
    taken = np.arange(len(FREQUENCIES))[::-1]
    if order == "shuffled":
        taken = np.random.default_rng(1).permutation(taken)
    swept = response(np.zeros(3), TARGET)
    np.savez(tmp_path / "x.npz", s=swept[taken], f=FREQUENCIES[taken])
    (tmp_path / "x.toml").write_text(
        'frame = 2\n[data]\nfile = "x.npz"\nvariable = "s"\ndimensions = ["sample"]\n'
        'conjugate = true\n[sweep]\nfrequencies = "f"\n'
    )
    found = read_sweeps(tmp_path / "x.toml")
    assert found.beat[0, 0, 0].tolist() == pytest.approx(swept.conj().tolist())
    touchstone(tmp_path / "x.s2p", swept[::-1], FREQUENCIES[::-1])
    assert torch.allclose(read_sweeps(tmp_path / "x.s2p").beat, found.beat, atol=1e-12)


@pytest.mark.parametrize("head", ["x, y, z", "X [m];Y [m];Z [m]", "z (m)\ty (m)\tx (m)"])
def test_positions_as_other_programs_write_them(rail, head):
    places = read_sweeps(rail).radar().positions
    mark = next(mark for mark in (";", "\t", ", ") if mark in head)
    rows = [row[::-1] if head.startswith("z") else row for row in RAIL]
    lines = [head, *(mark.join(f"{value:.9f}" for value in row) for row in rows)]
    text = "\n".join(lines)
    (rail.parent / "rail.csv").write_text(text.replace(".", ",") if mark == ";" else text)
    assert torch.allclose(read_sweeps(rail).radar().positions, places, atol=1e-8)


@pytest.mark.parametrize("head", ["x [mm],y [mm],z [mm]", "0,0,0"])
def test_positions_without_known_heads_are_refused(rail, head):
    (rail.parent / "rail.csv").write_text(f"{head}\n0,0,0\n")
    with pytest.raises(InputError, match=r"begin with a line x,y,z"):
        read_sweeps(rail)


def test_files_must_be_swept_alike(rail):
    touchstone(rail.parent / "empty.s2p", np.ones(101), FREQUENCIES + 1e6)
    with pytest.raises(InputError, match=r"frequencies of the first file in empty.s2p.*alike"):
        read_sweeps(rail)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("frame = 2", "frame = 3", "expected frame = 2 in rail.toml, got 3"),
        ("[radar]", "[radar]\nlook_at = 3.0", "look_at in \\[radar\\] as numbers of shape"),
        ('files = "rail_*.s2p"', 'files = "rails_*.s2p"', "expected files 'rails_"),
        ('files = "rail_*.s2p"', "", "either file or files in \\[data\\], got neither"),
        ('positions = "rail.csv"', "", "expected positions of 17 frames"),
        ('positions = "rail.csv"', "positions = [[0, 0, 0]]", "positions in \\[radar\\]"),
        ('positions = "rail.csv"', 'positions = "x"', "rail_00.s2p has no variables"),
        ('positions = "rail.csv"', 'positions = "empty.csv"', "got no file"),
        ("[sweep]", "[sweep]\nbands = 2", "sections data, sweep, radar with the keys"),
        ("[radar]", "[radar]\nrange_origin = 1\nrange_center = [0, 0, 0]", "got both"),
        ("[radar]", "[radar]\nrange_origin = [1, 2]", "range_origin in \\[radar\\]"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_descriptions_that_do_not_fit_are_one_line(rail, old, new, match):
    rail.write_text(rail.read_text().replace(old, new))
    with pytest.raises(InputError, match=match):
        read_sweeps(rail)


# A pass of 10° at 1 km, as phase histories of SAR are stored: z up as ours, centred on the scene.
GOTCHA = """\
frame = 2

[data]
file = "{file}"
variable = "{of}fp"
dimensions = ["sample", "frame"]
conjugate = true

[sweep]
frequencies = "{of}freq"

[radar]
positions = ["{of}x", "{of}y", "{of}z"]
range_origin = "{of}r0"
"""


def history(point) -> dict[str, Any]:
    """exp(−4πj f (|p − x| − r0)/c) of a point, and where the antenna was."""
    turn = np.radians(np.linspace(-5, 5, 64))
    x, y, z = 800 * np.sin(turn), -800 * np.cos(turn), np.full(64, 600.0)
    r0 = np.sqrt(x**2 + y**2 + z**2)
    frequencies = 9.7e9 + 1.5e6 * np.arange(128)
    away = np.sqrt((x - point[0]) ** 2 + (y - point[1]) ** 2 + (z - point[2]) ** 2)
    fp = np.exp(-4j * np.pi * frequencies[:, None] * (away - r0) / SPEED_OF_LIGHT)
    return {"fp": fp, "freq": frequencies, "x": x, "y": y, "z": z, "r0": r0, "th": turn}


@pytest.mark.parametrize("kind", ["npz", "h5", "mat", "struct"])
def test_phase_histories_image_a_point(tmp_path, kind):
    point = [11.0, -6.5, 0.0]
    arrays, of = history(point), "data." if kind == "struct" else ""
    file = tmp_path / f"pass.{'mat' if kind == 'struct' else kind}"
    if kind == "npz":
        np.savez(file, **arrays)
    elif kind == "h5":
        with h5py.File(file, "w") as opened:
            for name, array in arrays.items():
                opened[name] = array
    else:
        scipy.io.savemat(file, {"data": arrays} if of else arrays)
    path = tmp_path / "pass.toml"
    path.write_text(GOTCHA.format(file=file.name, of=of))
    assert is_sweeps(path)
    capture = read_sweeps(path, trusted=kind != "struct")
    assert capture.radar().origins.tolist() == pytest.approx([1000.0] * 64)
    assert capture.radar().range_limits[0] == pytest.approx(-49.97, abs=0.01)
    step = torch.linspace(-2, 2, 41, dtype=torch.float64)
    around = torch.nn.functional.pad(torch.cartesian_prod(step, step), (0, 1))
    places = torch.tensor(point, dtype=torch.float64) + around
    image = backproject(capture, places).abs()
    # A cell is 0.09 m across and 0.98 m away.
    assert around[image.argmax()].abs().max() <= 0.1 + 1e-9
    assert float(image.max()) == pytest.approx(1.0, abs=0.05)
    capture.save(tmp_path / "pass.nc")
    assert torch.equal(Capture.load(tmp_path / "pass.nc").radar().origins, capture.radar().origins)


def test_variables_of_an_old_description_are_turned(tmp_path):
    arrays = history([1.0, 2.0, 0.0])
    np.savez(tmp_path / "pass.npz", **arrays)
    path = tmp_path / "pass.toml"
    path.write_text(GOTCHA.format(file="pass.npz", of="").removeprefix("frame = 2\n"))
    expected = np.stack([arrays[name] for name in "zxy"], axis=1)
    with pytest.warns(PhysicsWarning, match="positions in pass.toml .*; write frame = 2"):
        assert read_sweeps(path).radar().positions.tolist() == expected.tolist()


def test_a_centre_stands_for_the_origins(tmp_path):
    np.savez(tmp_path / "pass.npz", **history([1.0, 2.0, 0.0]))
    path = tmp_path / "pass.toml"
    text = GOTCHA.format(file="pass.npz", of="")
    path.write_text(text.replace('range_origin = "r0"', "range_center = [0.0, 0.0, 0.0]"))
    assert read_sweeps(path).radar().origins.tolist() == pytest.approx([1000.0] * 64)
    path.write_text(text.replace('frequencies = "freq"', ""))
    with pytest.raises(InputError, match="frequencies, or start_frequency and step"):
        read_sweeps(path)
    path.write_text(text.replace('frequencies = "freq"', "start_frequency = 9.7e9\nstep = 1.5e6"))
    assert math.isclose(read_sweeps(path).radar().waveform.center_frequency, 9.7e9 + 63.5 * 1.5e6)


def test_descriptions_as_the_docs_have_them(rail, repository):
    page = (repository / "docs" / "sweeps.md").read_text()
    analyser, passes = re.findall(r"^```ini\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    rail.write_text(analyser)
    assert read_sweeps(rail).radar().shape == (17, 1, 1)
    scipy.io.savemat(rail.parent / "pass.mat", {"data": history([1.0, 2.0, 0.0])})
    rail.write_text(passes)
    assert float(read_sweeps(rail, trusted=True).radar().origins[0]) == pytest.approx(1000.0)


WIDE = np.linspace(100e3, 6e9, 601)


@pytest.mark.parametrize("band", [None, [2e9, 4e9]])
def test_an_analyser_starts_at_100_khz_and_a_band_is_selected(tmp_path, band):
    distance = 2.4
    s21 = np.exp(-2j * np.pi * WIDE * 2 * distance / SPEED_OF_LIGHT)
    touchstone(tmp_path / "wide.s2p", s21, WIDE)
    path = tmp_path / "wide.toml"
    more = "" if band is None else f"band = {band}"
    path.write_text(f'[data]\nfile = "wide.s2p"\n[sweep]\n{more}\n')
    capture = read_sweeps(path)
    waveform = capture.radar().waveform
    inside = WIDE if band is None else WIDE[(band[0] <= WIDE) & (band[1] >= WIDE)]
    assert waveform.start_frequency == pytest.approx(inside[0])
    assert waveform.samples == len(inside)
    grid = capture.radar().grid(1.0, 4.0)
    profile = capture.spectrum(grid).abs()[0, :, 0, 0]
    assert float(grid.ranges[profile.argmax()]) == pytest.approx(distance, abs=0.05)


@pytest.mark.parametrize("band", ["[4e9, 2e9]", "[7e9, 8e9]", "2e9", "[1e9]"])
def test_bands_that_hold_nothing_are_named(tmp_path, band):
    touchstone(tmp_path / "wide.s2p", np.ones(len(WIDE)) + 0j, WIDE)
    path = tmp_path / "wide.toml"
    path.write_text(f'[data]\nfile = "wide.s2p"\n[sweep]\nband = {band}\n')
    with pytest.raises(InputError, match=r"sweep\.band: expected"):
        read_sweeps(path)
