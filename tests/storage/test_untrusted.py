"""Files from strangers: an error of one line, whatever is in them."""

import json
import zipfile

import numpy as np
import pytest
import torch

from invertwin.capture.channel_calibration import ChannelCalibration
from invertwin.capture.readers import described_arrays
from invertwin.capture.readers.described_sweeps import read_sweeps
from invertwin.capture.ti.mmwave_studio import read_studio
from invertwin.capture.ti.sdk_cfg import read_cfg
from invertwin.cli.run_file import load_run
from invertwin.cli.schema import build
from invertwin.errors import InputError
from invertwin.scene import plate
from invertwin.scene.files import load_mesh, load_scene_xml, save_mesh
from invertwin.storage.untrusted import (
    convert_read_errors,
    read_arrays,
    read_npy,
    read_text,
    safe_reader,
)

DESCRIPTION = """
[data]
file = "{}"
variable = "adc"
[settings]
start_frequency = 77e9
slope = 60e12
sample_rate = 5e6
"""
COMMANDS = """% Platform:xWR18xx
channelCfg 15 3 0
adcCfg 2 1
profileCfg 0 77 7 6 60 0 0 60 1 64 5000 0 0 30
chirpCfg 0 {} 0 0 0 0 0 1
frameCfg 0 {} 16 0 100 1 0
"""
SCENE = 'task = "simulate"\n[scene.a]\nfile = "{}"\nmaterial = {{ kind = "perfect_conductor" }}'


def scene_of(path):
    return build.scene(load_run(path))


@pytest.mark.parametrize(
    ("name", "text", "read"),
    [
        ("a.toml", "x=" + "[" * 20_000 + "]" * 20_000, load_run),
        ("a.toml", "seed=1" + "0" * 5_000, load_run),
        ("a.toml", SCENE.format("a" * 5_000), scene_of),
        ("a.toml", SCENE.format("a\\u0000b"), scene_of),
        ("a.xml", '<?xml version="1.0" encoding="foo"?><scene/>', load_scene_xml),
        ("a.xml", '<?xml version="1.0" encoding="utf-7"?><scene/>', load_scene_xml),
        ("a.json", "[" * 100_000, ChannelCalibration.load),
        ("a.json", '{"gains":[[[1' + "0" * 400 + ",0]]]}", ChannelCalibration.load),
        ("a.json", json.dumps({"gains": "x"}), ChannelCalibration.load),
        ("a.gltf", json.dumps({"meshes": [{"primitives": [{}]}], "nodes": [{}]}), load_mesh),
        ("a.cfg", COMMANDS.format(4_000_000_000, 1), read_cfg),
        ("a.cfg", COMMANDS.format(1, 4_000_000_000), read_cfg),
    ],
)
def test_text_of_any_kind_is_one_line(tmp_path, name, text, read):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=r"expected .*, got ") as caught:
        read(tmp_path / name)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1_000


@pytest.mark.parametrize("coding", ["utf-8", "utf-8-sig", "latin-1", "cp1252", "gbk", "shift-jis"])
def test_comments_of_windows_tools_do_not_refuse_a_file(tmp_path, coding):
    comment = {"gbk": "测量…", "shift-jis": "測定"}.get(coding, "23 °C, für Prüfling ±½")
    comment += "…" if coding in ("utf-8", "cp1252") else ""
    file = tmp_path / "sweep.s1p"
    file.write_bytes(f"! {comment}\n# GHz S RI\n1 0.5 0\n".encode(coding))
    lines = read_text(file, "a sweep").splitlines()
    assert lines[0].startswith("!")
    assert lines[1:] == ["# GHz S RI", "1 0.5 0"]


@pytest.mark.parametrize("coding", ["utf-16", "utf-8-sig"])
def test_marks_of_byte_order_tell_the_coding(tmp_path, coding):
    file = tmp_path / "sweep.s1p"
    file.write_bytes("# GHz S RI\n1 0.5 0\n".encode(coding))
    assert read_text(file, "a sweep").splitlines() == ["# GHz S RI", "1 0.5 0"]


def test_data_are_no_text(tmp_path):
    file = tmp_path / "samples.cfg"
    file.write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match="it is no text"):
        read_text(file, "settings")


def test_a_name_too_long_for_a_file_is_no_file():
    with pytest.raises(InputError, match="got no file aaa"):
        load_mesh("a" * 5_000 + ".ply")


def lying(shape, values, kind="<f8"):
    """A NumPy file whose header says a shape that its numbers do not have."""
    header = repr({"descr": kind, "fortran_order": False, "shape": shape}).ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + values


def test_headers_that_lie_are_refused_before_memory_is_asked_for(tmp_path):
    file = tmp_path / "a.npy"
    file.write_bytes(lying((2,), np.ones(2).tobytes()))
    assert read_npy(file).tolist() == [1.0, 1.0]
    file.write_bytes(lying((10**13,), b"\0" * 16))
    with pytest.raises(InputError, match="more than the file holds"):
        read_npy(file)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.write(file, "b.npy")
    with pytest.raises(InputError, match="more than the file holds"):
        read_arrays(tmp_path / "a.npz", "copy it again")
    (tmp_path / "b.npz").write_bytes(file.read_bytes())
    with pytest.raises(InputError, match=r"b\.npz"):
        read_arrays(tmp_path / "b.npz", "copy it again")


def test_an_empty_file_is_refused_before_it_is_opened(tmp_path):
    """Such as those of /proc, which have no size and can block their reader."""
    (tmp_path / "a.toml").touch()
    for read in (load_run, read_npy, load_mesh):
        with pytest.raises(
            InputError, match=r"got an empty file, .*a\.toml; name a file with data"
        ):
            read(tmp_path / "a.toml")


def test_an_archive_that_expands_beyond_reason_is_refused(tmp_path):
    """By what it says of itself: no byte of the array is read."""
    file = tmp_path / "bomb.npz"
    np.savez_compressed(file, zeros=np.zeros(2**26, dtype=np.float64))
    assert file.stat().st_size < 2**20
    with pytest.raises(InputError, match=r"0.54 GB in zeros of a small file"):
        read_arrays(file, "make it again")


def test_numbers_come_in_the_order_of_bytes_of_this_machine(tmp_path):
    np.savez(tmp_path / "a.npz", big=np.arange(3, dtype=">f8"), text=np.array(["a"]))
    found = read_arrays(tmp_path / "a.npz", "make it again")
    assert found["big"].dtype.isnative
    assert torch.from_numpy(found["big"]).tolist() == [0.0, 1.0, 2.0]
    assert found["text"].tolist() == ["a"]
    np.save(tmp_path / "a.npy", np.arange(3, dtype=">f8"))
    assert torch.from_numpy(read_npy(tmp_path / "a.npy")).tolist() == [0.0, 1.0, 2.0]


def test_all_of_a_reader_is_wrapped():
    @safe_reader("a mesh", "export it")
    def read(path, number=0):
        return 1 / number

    assert read("a.ply", number=4) == 0.25
    for call in (lambda: read("a.ply"), lambda: read(path="a.ply")):
        with pytest.raises(InputError, match=r"expected a mesh, got a\.ply \(ZeroDiv.*; export it"):
            call()


def test_warnings_that_are_errors_stay_warnings():
    with pytest.raises(UserWarning, match="as it was"), convert_read_errors("a.ply", "a mesh"):
        raise UserWarning("as it was")


@pytest.mark.parametrize(
    ("name", "text", "read"),
    [
        # What `make fuzz` has found.
        ("a.setup.json", '{"configUsed": "b.json", "DCA1000Config": "x"}', read_studio),
        ("a.setup.json", json.dumps({"configUsed": "b" * 5_000}), read_studio),
        ("a.setup.json", '{"configUsed": "b.json", "DCA1000Config": 1.5}', read_studio),
        (
            "a.toml",
            DESCRIPTION.format("q.npy").replace("[data]", "[data]\ndimensions = [[]]"),
            None,
        ),
        ("a.toml", DESCRIPTION.format("q.npy") + "transmit_order = 3\n", None),
    ],
)
def test_values_of_another_kind_are_one_line(tmp_path, name, text, read):
    np.save(tmp_path / "q.npy", np.ones((2, 4, 2, 4, 16), np.complex64))
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match="expected ") as caught:
        (read or described_arrays.read_chirps)(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_errors_of_readers_name_the_file_and_pass_input_errors_on():
    told = r"expected a mesh, got a\.ply \(ValueError: x y\)"
    with pytest.raises(InputError, match=told), convert_read_errors("a.ply", "a mesh"):
        raise ValueError("x\ny")
    with pytest.raises(InputError, match=r"^as it was$"), convert_read_errors("a.ply", "a mesh"):
        raise InputError("as it was")


@pytest.mark.parametrize(
    ("line", "passes"),
    [
        ("no_such_name", NameError),
        ("len.no_such_attribute", AttributeError),
        ("'a value of JSON'.get('key')", None),
        ("None.get('key')", None),
        ("from decimal import Decimal; Decimal('1.5').get('key')", None),
        ("from datetime import date; date(2026, 1, 1).get('key')", None),
        ("import numpy; numpy.zeros(2).split('/')", None),
        ("import no_such_module", ImportError),
        ("def f():\n  x += 1\nf()", UnboundLocalError),
        ("assert not 1", AssertionError),
        ("int('x')", None),
        ("import json; json.loads('{')", None),
    ],
)
def test_faults_of_our_own_lines_are_not_those_of_a_file(line, passes):
    """A name that we forgot passes; what a library raises of itself is one line."""
    for module in ("invertwin.capture.readers.new", "pandas.io"):
        ours = passes is not None and module.startswith("invertwin")
        kept = passes if ours else InputError
        with pytest.raises(kept or InputError), convert_read_errors("a.ply", "a mesh"):
            exec(line, {"__name__": module})


SWEEP = "# Hz S RI R 50\n1e9 0.5 0\n2e9 0.5 0\n"
ELSEWHERE = ("../out/b.{}", "link.{}", "in/b.{}", "here/../../out/b.{}", "{}/out/b.{}")


@pytest.mark.parametrize("named", ELSEWHERE)
@pytest.mark.parametrize("key", ["file", "files", "glob", "background", "positions"])
def test_descriptions_read_nothing_beyond_their_folder(tmp_path, key, named):
    """By `..`, by absolute names, by links to files and to folders, also among patterns."""
    ending = "csv" if key == "positions" else "s1p"
    named = named.format(*[ending] if named.count("{}") == 1 else [tmp_path, ending])
    folder, out = tmp_path / "set", tmp_path / "out"
    for place in (folder, out, folder / "here"):
        place.mkdir()
    (out / "b.s1p").write_text(SWEEP)
    (out / "b.csv").write_text("x,y,z\n0,0,0\n")
    (folder / "a.s1p").write_text(SWEEP)
    (folder / f"link.{ending}").symlink_to(out / f"b.{ending}")
    (folder / "in").symlink_to(out)
    data = {
        "file": f'file = "{named}"\n',
        "files": f'files = ["a.s1p", "{named}"]\n',
        "glob": f'files = "{named.replace("b.", "*.").replace("link", "l*")}"\n',
    }.get(key, 'file = "a.s1p"\n')
    more = {
        "background": f'[sweep]\nbackground = "{named}"\n',
        "positions": f'[radar]\npositions = "{named}"\n',
    }
    (folder / "a.toml").write_text("frame = 2\n[data]\n" + data + more.get(key, ""))
    with pytest.raises(InputError, match=r"expected names of files in the folder of .*elsewhere"):
        read_sweeps(folder / "a.toml")


def test_descriptions_read_what_lies_in_their_folder_or_below(tmp_path):
    """Also where the folder itself is reached by a link."""
    (tmp_path / "set" / "in").mkdir(parents=True)
    for name in ("a.s1p", "in/b.s1p", "in/c.s1p"):
        (tmp_path / "set" / name).write_text(SWEEP)
    (tmp_path / "set" / "to.s1p").symlink_to("a.s1p")
    (tmp_path / "link").symlink_to(tmp_path / "set")
    points = "[radar]\npositions = [[0, 0, 0], [0, 1, 0]]\n"
    for data in ('files = "in/*.s1p"', 'files = ["to.s1p", "in/../a.s1p"]'):
        (tmp_path / "set" / "a.toml").write_text(f"frame = 2\n[data]\n{data}\n{points}")
        assert read_sweeps(tmp_path / "link" / "a.toml").frame_count == 2
    (tmp_path / "set" / "a.toml").write_text('[data]\nfiles = "z*.s1p"\n')
    with pytest.raises(InputError, match=r"expected files 'z\*\.s1p' beside"):
        read_sweeps(tmp_path / "set" / "a.toml")


def test_meshes_of_a_scene_file_lie_beside_it(tmp_path):
    (tmp_path / "set").mkdir()
    save_mesh(tmp_path / "a.ply", plate(1.0, 1.0))
    text = '<scene version="3.0.0"><shape type="ply" id="a"><string name="filename" value="{}"/>'
    (tmp_path / "set" / "a.xml").write_text(text.format("../a.ply") + "</shape></scene>")
    with pytest.raises(InputError, match=r"got '\.\./a\.ply', which is elsewhere"):
        load_scene_xml(tmp_path / "set" / "a.xml")


@pytest.mark.parametrize("content", [(1,), {1}, torch.zeros(2), np.zeros(2), 1j, bytearray(b"x")])
def test_a_value_of_another_kind_is_a_fault_of_the_file(tmp_path, content):
    said = pytest.raises(InputError, match=r"expected a fit, got .*no attribute 'items'")
    with said, convert_read_errors(tmp_path / "a.pt", "a fit"):
        exec("content.items()", {"__name__": "invertwin.reader", "content": content})
