"""Measured signatures: tables of cross-sections and Touchstone files."""

import math

import pytest
import torch

from invertwin.capture import load_rcs, load_touchstone
from invertwin.errors import InputError

TWO_PORTS = """! made by hand
# MHz S DB R 75
100 -6.0206 0 -20 90 -40 180 0 -90   ! S11 S21 S12 S22
200 -6.0206 0 -20 90
    -40 180 0 -90
50 1.0 0.5 20 0.3
"""


def test_rows_of_a_cross_section(tmp_path):
    file = tmp_path / "plate.txt"
    file.write_text("1e9 90.0 0.0 -3.5\n1e9 90.0 45.0 -20.0 \n")
    found = load_rcs(file)
    assert found.frequency.tolist() == [1e9, 1e9]
    assert found.phi.tolist() == pytest.approx([0.0, math.pi / 4])
    assert found.dbsm.tolist() == [-3.5, -20.0]


@pytest.mark.parametrize("text", ["", "1 2 3\n", "1 2 3 x\n", "1e9 90 0 nan\n", "1 2 3 4\n1 2\n"])
def test_other_tables_are_refused(tmp_path, text):
    file = tmp_path / "plate.txt"
    file.write_text(text)
    with pytest.raises(InputError, match="expected rows of frequency, theta, phi and RCS"):
        load_rcs(file)


def test_two_ports_with_noise(tmp_path):
    file = tmp_path / "horn.s2p"
    file.write_text(TWO_PORTS)
    found = load_touchstone(file)
    assert found.frequencies.tolist() == [1e8, 2e8]
    assert found.resistance == 75
    s11, s21, s12, s22 = found.parameters[1, [0, 1, 0, 1], [0, 0, 1, 1]].tolist()
    assert s11 == pytest.approx(0.5, abs=1e-5)
    assert s21 == pytest.approx(0.1j, abs=1e-9)
    assert s12 == pytest.approx(-0.01, abs=1e-9)
    assert s22 == pytest.approx(-1j, abs=1e-9)


@pytest.mark.parametrize(
    ("options", "row", "expected"),
    [("# GHz S RI R 50", "3 0.3 -0.4", 0.3 - 0.4j), ("", "3 0.5 90", 0.5j)],
)
def test_one_port_in_its_formats(tmp_path, options, row, expected):
    file = tmp_path / "antenna.S1P"
    file.write_text(f"{options}\n{row}\n")
    found = load_touchstone(file)
    assert found.frequencies.tolist() == [3e9]
    assert found.parameters[0, 0, 0].item() == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("order", [(3, 2, 1), (1, 2, 2)])
def test_no_frequency_is_lost_in_two_ports(tmp_path, order):
    """Falling ones, and one twice, as where two segments meet, are no noise data."""
    rows = [f"{f} {f} 0 0 0 0 0 0 0" for f in order]
    (tmp_path / "a.s2p").write_text("\n".join(["# Hz S RI R 50", *rows]))
    found = load_touchstone(tmp_path / "a.s2p")
    assert found.frequencies.tolist() == sorted(order)
    assert found.parameters[:, 0, 0].tolist() == sorted(order)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.txt", "1 2 3", "a Touchstone file such as .s1p"),
        ("a.s1p", "# GHz Z RI R 50\n1 2 3", "a Touchstone file of 1 ports"),
        ("a.s1p", "1 2", "a Touchstone file of 1 ports"),
        ("a.s1p", "", "a Touchstone file of 1 ports"),
        ("a.s1p", "1 two 3", "a Touchstone file of 1 ports"),
        ("a.s1p", "1 0,5 0", "with points as decimal marks"),
    ],
)
def test_damaged_files_are_one_line(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        load_touchstone(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_three_ports_are_listed_row_by_row(tmp_path):
    file = tmp_path / "hub.s3p"
    values = " ".join(f"{n} 0" for n in range(1, 10))
    file.write_text(f"# Hz S RI\n7 {values}\n")
    found = load_touchstone(file).parameters
    assert torch.equal(found.real[0], torch.arange(1.0, 10.0, dtype=torch.float64).reshape(3, 3))


VERSION_2 = """! 23 °C, measured
[Version] 2.0
# GHz S RI R 50
[Number of Ports] 2
[Two-Port Data Order] {order}
[Number of Frequencies] 2
{more}[Network Data]
{rows}
{end}
"""


@pytest.mark.parametrize(
    ("order", "more", "row", "end"),
    [
        ("21_12", "", "0.5 0 0 0.1 0.01 0 0.4 0", "[End]"),
        ("12_21", "", "0.5 0 0.01 0 0 0.1 0.4 0", "[End]"),
        ("21_12", "[Reference]\n50\n50\n", "0.5 0 0 0.1 0.01 0 0.4 0", "[End]"),
        ("12_21", "[Number of Noise Frequencies] 1\n", "0.5 0 0.01 0 0 0.1\n0.4 0",
         "[Noise Data]\n2 1 0.5 20 0.3\n[End]"),
        ("12_21", "[Begin Information]\n[Note] 1 2 3\n[End Information]\n",
         "0.5 0 0.01 0 0 0.1 0.4 0", "[End]"),
    ],
)  # fmt: skip
def test_version_2_states_order_and_counts(tmp_path, order, more, row, end):
    file = tmp_path / "horn.s2p"
    rows = f"1 {row}\n2 {row}"
    text = VERSION_2.format(order=order, more=more, rows=rows, end=end)
    file.write_text(text, encoding="utf-8")
    found = load_touchstone(file)
    assert found.frequencies.tolist() == [1e9, 2e9]
    assert found.resistance == 50
    assert found.parameters[1].tolist() == [[0.5, 0.01], [0.1j, 0.4]]


@pytest.mark.parametrize(
    ("layout", "row"), [("Lower", "1 0 2 0 4 0 3 0 5 0 6 0"), ("Upper", "1 0 2 0 3 0 4 0 5 0 6 0")]
)
def test_triangles_of_symmetric_matrices(tmp_path, layout, row):
    file = tmp_path / "hub.ts"
    head = f"[Version] 2.1\n# Hz S RI\n[Number of Ports] 3\n[Matrix Format] {layout}\n"
    file.write_text(
        f"{head}[Number of Frequencies] 1\n[Reference] 75 75 75\n[Network Data]\n7 {row}"
    )
    found = load_touchstone(file)
    assert found.resistance == 75
    assert found.parameters[0].real.tolist() == [[1, 2, 3], [2, 4, 5], [3, 5, 6]]


def test_lower_triangle_of_two_ports_holds_the_way_through(tmp_path):
    file = tmp_path / "horn.s2p"
    more, row = "[Matrix Format] Lower\n", "0.5 0 0 0.1 0.4 0"
    text = VERSION_2.format(order="21_12", more=more, rows=f"1 {row}\n2 {row}", end="[End]")
    file.write_text(text, encoding="utf-8")
    assert load_touchstone(file).parameters[0].tolist() == [[0.5, 0.1j], [0.1j, 0.4]]


@pytest.mark.parametrize(
    "change",
    [
        ("[Number of Frequencies] 2", "[Number of Frequencies] 3"),
        ("[Number of Ports] 2", "[Number of Ports] 1"),
        ("[Network Data]", "[Mixed-Mode Order] D2,3 C2,3\n[Network Data]"),
    ],
)
def test_version_2_that_contradicts_itself_is_refused(tmp_path, change):
    file = tmp_path / "horn.s2p"
    row = "0.5 0 0 0.1 0.01 0 0.4 0"
    text = VERSION_2.format(order="21_12", more="", rows=f"1 {row}\n2 {row}", end="[End]")
    file.write_text(text.replace(*change), encoding="utf-8")
    with pytest.raises(InputError, match="a Touchstone file of 2 ports"):
        load_touchstone(file)
