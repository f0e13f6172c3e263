"""Tables in a terminal."""

import os
import subprocess
import sys

import pytest
from rich.console import Console

from invertwin.cli import terminal as running
from invertwin.cli.report import ReportTable


@pytest.mark.parametrize("width", [40, 80, 200])
def test_a_narrow_terminal_never_cuts_a_number(monkeypatch, capsys, width):
    monkeypatch.setattr(running, "console", Console(width=width))
    columns = ["scene", *(f"a long heading {k}" for k in range(8))]
    running.print_tables([ReportTable("Errors", columns, [["letter_scale", *[0.00123456] * 8]])])
    printed = capsys.readouterr().out
    assert printed.count("0.001235") == 8
    assert "letter_scale" in printed
    assert "…" not in printed


@pytest.mark.parametrize("coding", ["ascii", "latin-1"])
def test_terminals_of_few_letters_show_tables(coding):
    call = [sys.executable, "-m", "invertwin", "keys", "radar"]
    settings = {"PYTHONIOENCODING": coding, "PYTHONUTF8": "0"}
    done = subprocess.run(call, capture_output=True, env=os.environ | settings)
    assert done.returncode == 0, done.stderr
    assert b"| positions" in done.stdout


def test_a_matplotlibrc_of_the_folder_changes_nothing(tmp_path, monkeypatch):
    (tmp_path / "matplotlibrc").write_bytes(b"text.usetex: True\nfigure.dpi: \xff\n")
    monkeypatch.chdir(tmp_path)
    code = (
        "from invertwin.cli.report import use_plain_style; use_plain_style(); import matplotlib; "
        "print(matplotlib.rcParams['text.usetex'], matplotlib.rcParams['figure.dpi'])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "False 100.0\n"
    assert done.stderr == ""
