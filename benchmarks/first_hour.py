"""The first hour of a newcomer, by the command line alone: from `invertwin new` to a report.

    python benchmarks/first_hour.py [-o DIR] [step ...]

The newcomer knows `invertwin --help` and what the files say that `invertwin new` writes. They draw
a crate as a mesh, put it before a board of a maker, simulate raw files, look at these as if they
were a recording, fit where the crate stands, search for what nothing is known of, write a plugin.
Every step is a process of its own in one empty folder, and asserts what it printed and wrote.
Prints a table and writes `metrics.json` into DIR (default `out/first_hour`):

- `failed_steps`: steps whose output was not what it should be; `failures` says why.
- `processor_seconds`: of all steps; `seconds.<step>` of each [s].
- `headline_over_bar`: the largest error of what the fit's sentence states, place and angle, over
  its 95 % bar.
- `look_error_m`: between the range that `look` states of the raw files and the face of the crate.
- `twin_error_m`: the largest distance between a box of the twin and the nearest thing found.
"""

import argparse
import html
import json
import math
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from report import MetricTable, Required, write

REQUIRED: Required = {
    "failed_steps": ("<=", 0),
    "processor_seconds": ("<=", 480.0),
    "headline_over_bar": ("<=", 1.0),
    "look_error_m": ("<=", 0.05),
    "twin_error_m": ("<=", 0.15),
}
COUNTED = {
    "failed_steps": (".3g", "steps whose output is not what it should be"),
    "processor_seconds": (".3g", "of all steps [s]"),
    "headline_over_bar": (".3g", "largest error of the fit's sentence over its 95 % bar"),
    "look_error_m": (".3g", "of the range of the crate in its raw files [m]"),
    "twin_error_m": (".3g", "between a box and the nearest thing found [m]"),
}
SIDES = (0.3, 0.5, 0.4)  # of the crate [m]
BOARD = 'board = { name = "IWR6843ISK", elevation = 1 }'


@dataclass
class Newcomer:
    """Somebody in a folder, who remembers what they have measured.

    Attributes:
        folder: Where they type.
        found: Metrics so far.
    """

    folder: Path
    found: dict[str, Any] = field(default_factory=dict)

    def types(
        self, *words: str, code: int = 0, program: tuple[str, ...] = ("-m", "invertwin")
    ) -> str:
        """What a command prints, on one line.

        Args:
            words: Of the command, after `invertwin`.
            code: With which it ends.
            program: Of Python.
        """
        call = [sys.executable, *program, *words]
        done = subprocess.run(call, cwd=self.folder, capture_output=True, text=True)
        said = done.stdout + done.stderr
        assert done.returncode == code, said[-2000:]
        return " ".join(said.split())

    def reads(self, name: str) -> str:
        """The text of a file in the folder."""
        return (self.folder / name).read_text(encoding="utf-8")

    def edits(self, name: str, into: str, changes: dict[str, str]) -> None:
        """Copy a file, with lines that begin so replaced; "" takes them out.

        Args:
            name: Of the file.
            into: Name of the copy.
            changes: New lines by the beginnings of old ones.
        """
        lines = self.reads(name).splitlines()
        for begin, new in changes.items():
            at = [i for i, line in enumerate(lines) if line.startswith(begin)]
            assert at, f"no line of {name} begins with {begin}"
            lines[at[0]] = new
        (self.folder / into).write_text("\n".join(lines) + "\n", encoding="utf-8")

    def metrics(self, folder: str) -> dict[str, Any]:
        """The numbers that a command has written."""
        return json.loads(self.reads(f"{folder}/metrics.json"))


def writes_files(user: Newcomer) -> None:
    """`invertwin new` names the command that runs what it writes."""
    assert "new" in user.types("--help")
    for kind, command in (("fit", "reconstruct"), ("simulate", "simulate"), ("twin", "twin")):
        said = user.types("new", kind)
        assert f"wrote {kind}.toml; try: invertwin {command} {kind}.toml" in said, said
        assert f"# Run it: invertwin {command} {kind}.toml" in user.reads(f"{kind}.toml")


def draws_mesh(user: Newcomer) -> None:
    """The crate as a Wavefront file, and the file of `new` with it and with a board."""
    corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    rows = [[0.5 * s * c for s, c in zip(SIDES, corner, strict=True)] for corner in corners]
    faces = ["1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4"]
    lines = [*("v {} {} {}".format(*row) for row in rows), *(f"f {face}" for face in faces)]
    (user.folder / "crate.obj").write_text("\n".join(lines), encoding="utf-8")
    box = {'shape = "box"': 'file = "crate.obj"', "size = ": ""}
    board = {"transmitters = ": BOARD, "receivers = ": "", "# [raw]": "[raw]"}
    ramp = "start_frequency = 60e9, bandwidth = 3.6e9, duration = 50e-6, samples = 128"
    board["waveform = "] = f"waveform = {{ kind = 'fmcw', {ramp} }}"
    user.edits("simulate.toml", "bench.toml", box | board | {"rotation_deg = ": ""})
    user.edits("fit.toml", "crate.toml", box)
    said = user.types("check", "crate.toml")
    assert "triangles" in said, said


def misspells(user: Newcomer) -> None:
    """Everything that is wrong or missing is said on one line that helps."""
    user.edits("bench.toml", "wrong.toml", {"board = ": BOARD.replace("ISK", "ISX")})
    said = user.types("simulate", "wrong.toml", code=2)
    assert all(word in said for word in ("radar.board.name", "IWR6843ISK")), said
    said = user.types("look", "recording.bin", code=2)
    assert all(word in said for word in ("no file", "--config", "--board", "IWR6843ISK")), said


def simulates(user: Newcomer) -> None:
    """The front of the crate is where it was put, in the sentence and in the numbers."""
    said = user.types("simulate", "bench.toml")
    assert "complete: out/bench/report.html" in said, said
    assert re.search(r"Strongest echo 1\.8\d m away, azimuth \d", said), said
    assert (user.folder / "out/bench/raw/capture.bin").stat().st_size == 12 * 128 * 4


def looks(user: Newcomer) -> None:
    """The raw files, read back as a recording of the board."""
    raw = "out/bench/raw/capture"
    mount = ("--board", "IWR6843ISK", "--elevation", "1")
    assert "Platform:xWR68xx" in user.reads(f"{raw}.cfg")
    said = user.types("look", f"{raw}.bin", "--config", f"{raw}.cfg", *mount, "-o", "out/look")
    found = user.metrics("out/look")
    # The crate is 2 m ahead and 0.3 m to the left; its front faces the radar.
    user.found["look_error_m"] = abs(found["peak_range_m"] - (2.0 - SIDES[0] / 2))
    assert found["channels"] == 12
    assert 0 < found["peak_azimuth_deg"] < math.degrees(math.atan2(0.3 + SIDES[1] / 2, 1.85))
    assert found["answer"] in said, said
    assert found["answer"] in html.unescape(user.reads("out/look/report.html"))


def fits(user: Newcomer) -> None:
    """The sentence of a fit states place and angle of the crate within its bars."""
    said = user.types("reconstruct", "crate.toml", "-o", "out/fit")
    found = user.metrics("out/fit")
    answer = found["answer"]
    assert answer in said, said[-600:]
    number = r"(-?[\d.]+)"
    place = re.search(rf"\({number}, {number}, {number}\)", answer)
    turn = re.search(rf"yaw {number}", answer)
    assert place, answer
    assert turn, answer
    told = [float(place[1]), float(place[2]), float(turn[1])]
    truth = {"box.x": 2.06, "box.y": 0.08, "box.yaw": 10.0}
    bars = [found["within_95"][name] for name in truth]
    bars[2] = math.degrees(bars[2])
    over = [abs(v - t) / bar for v, t, bar in zip(told, truth.values(), bars, strict=True)]
    user.found["headline"] = answer
    user.found["headline_over_bar"] = max(over)


def reads_report(user: Newcomer) -> None:
    """The report has the sentence, its pictures within it, and a command that works as printed."""
    page = html.unescape(user.reads("out/fit/report.html"))
    assert user.found["headline"].split(";")[0] in page
    assert page.count("data:image/png;base64,") >= 3
    again = re.search(r"<pre>invertwin (reconstruct .*?)</pre>", page)
    assert again, "no command in the report"
    user.types("view", "out/fit", "--record", "fit.html")
    assert "<!DOCTYPE html>" in user.reads("fit.html")


def searches(user: Newcomer) -> None:
    """Both boxes of a room that nothing is known of."""
    said = user.types("twin", "twin.toml", "-o", "out/found")
    found = user.metrics("out/found")
    assert found["answer"] in said, said[-600:]
    places = [one["position_m"][:2] for one in found["things"] if one["confidence"] > 0.5]
    boxes = [(2.3, -0.6), (2.8, 0.6)]
    user.found["twin_error_m"] = max(min(math.dist(p, box) for p in places) for box in boxes)
    user.found["twin_answer"] = found["answer"]
    assert (user.folder / "out/found/twin.toml").is_file()


def extends(user: Newcomer) -> None:
    """A plugin runs as it is written, and its shape is one of run files."""
    assert "wrote plugin.py; try: python plugin.py" in user.types("new", "plugin")
    assert "strongest echo" in user.types(program=("plugin.py",))
    shape = {'shape = "box"': 'shape = "pyramid"', "size = ": "side = 0.4"}
    user.edits("simulate.toml", "pyramid.toml", shape)
    said = user.types("simulate", "pyramid.toml", program=("plugin.py",))
    assert "complete: out/pyramid/report.html" in said, said


STEPS: dict[str, Callable[[Newcomer], None]] = {
    step.__name__: step
    for step in (
        *(writes_files, draws_mesh, misspells, simulates, looks),
        *(fits, reads_report, searches, extends),
    )
}


def measure(steps: list[str]) -> dict[str, Any]:
    """Make the steps in a folder of their own; none is left out because one before it failed."""
    seconds, failures = {}, {}
    with tempfile.TemporaryDirectory() as name:
        user = Newcomer(Path(name))
        for step in steps:
            before = _processors()
            try:
                STEPS[step](user)
            except (AssertionError, OSError, KeyError) as error:
                failures[step] = f"{type(error).__name__}: {error}"
            seconds[step] = _processors() - before
            print(f"{step:14} {seconds[step]:6.1f} s {failures.get(step, '')}", flush=True)
    return {
        "failed_steps": len(failures),
        "processor_seconds": sum(seconds.values()),
        **{key: None for key in COUNTED if key not in ("failed_steps", "processor_seconds")},
        **user.found,
        "failures": failures,
        "seconds": seconds,
    }


def _processors() -> float:
    return sum(os.times()[2:4])


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/first_hour"))
    parser.add_argument("steps", nargs="*", default=[*STEPS], help="default: all, in this order")
    given = parser.parse_args()
    metrics = measure(given.steps)
    table = MetricTable("The first hour", REQUIRED)
    table.rows(metrics, COUNTED)
    write(metrics, table.grid, given.out)


if __name__ == "__main__":
    main()
