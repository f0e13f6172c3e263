"""The report is one file that loads nothing."""

import html
import re
import shlex
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from cli.small import RUN, call
from invertwin.cli import report
from invertwin.cli.options import LookOptions, TwinOptions
from invertwin.cli.report import ReportPicture, ReportTable, report_html

PNG = b"\x89PNG\r\n\x1a\n"


def test_report_is_self_contained_and_escaped():
    text = report_html(
        "A < B",
        "converged",
        "first\n\nsecond",
        [
            ReportTable(
                "Poses", ["name", "x", "ok"], [["<letter>", 0.123456, True], ["wall", None, False]]
            ),
            ReportPicture("Loss & steps", PNG + b"data", note="one & two"),
        ],
        "reconstruct run.toml",
        {"run.toml": 'task = "demo"'},
    )
    assert "A &lt; B" in text
    assert "&lt;letter&gt;" in text
    assert "0.1235" in text
    assert re.findall(r'(?:src|href)="(?!data:)', text) == []
    assert "data:image/png;base64,iVBOR" in text
    assert "<script" not in text
    assert "<p>first</p>\n<p>second</p>" in text
    assert "<pre>invertwin reconstruct run.toml -o again</pre>" in text
    assert "<title>A &lt; B</title>" in text
    assert '<p class="status">converged</p>' in text
    assert "<tr><td>&lt;letter&gt;</td><td>0.1235</td><td>yes</td></tr>" in text
    assert "<tr><td>wall</td><td>–</td><td>no</td></tr>" in text
    assert '<p class="lines">one &amp; two</p>' in text
    assert "<summary>run.toml</summary>\n<pre>task = &#34;demo&#34;</pre>" in text
    assert "{{" not in text
    assert "{%" not in text


NAMES = (
    "a b",
    "it's",
    'say "x"',
    "two\nlines",
    "$(touch x)",
    "a;b&c",
    "*.toml",
    "ü \\",
    "`id`",
    "~",
)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("kind", [LookOptions, TwinOptions])
def test_commands_of_reports_quote_the_names_of_files(tmp_path, kind, name):
    """A shell reads the words that were typed, from the folder of the report."""
    options = kind(recording=tmp_path / f"{name}.bin", config=tmp_path / name, board="xWR1843")
    options = replace(options, change=[f"receivers={name}", "samples=8"])
    line = options.command(kind.__name__[:4].lower(), tmp_path / "out")
    page = report_html("t", "s", "", [], line, {})
    (shown,) = re.findall(r"<pre>(.*?)</pre>", page, re.DOTALL)
    words = shlex.split(html.unescape(shown))
    assert words[:3] == ["invertwin", kind.__name__[:4].lower(), f"../{name}.bin"]
    given = dict(pairwise(words))
    assert given["--config"] == f"../{name}"
    assert given["--board"] == "xWR1843"
    assert f"receivers={name}" in words
    assert words[-2:] == ["-o", "again"]


def test_reports_of_all_other_commands_name_no_file_of_the_user():
    """Their run files lie beside the report, as run.toml or in runs/."""
    calls = []
    for file in (Path(report.__file__).parent / "commands").glob("*.py"):
        calls += re.findall(r'again(?:=|": )([^,)]+)', file.read_text())
    plain = {'"simulate"', '"reconstruct"', '"dataset"', '"gradcheck"', '"plan"', '"rcs"'}
    assert set(calls) == {*plain, 'options.command("look"', "again"}  # of look and twin


@pytest.mark.parametrize("name", ["a b", "it's", "$(touch x)"])
def test_commands_that_the_terminal_names_are_quoted(tmp_path, monkeypatch, capsys, name):
    monkeypatch.chdir(tmp_path)
    file = f"{name}.toml"
    assert call(monkeypatch, "new", "simulate", file) == 0
    said = capsys.readouterr().out.partition("; try: ")[2]
    assert shlex.split(said) == ["invertwin", "simulate", file]
    Path(file).write_text(RUN)
    assert call(monkeypatch, "gradcheck", file) == 2
    said = capsys.readouterr().err.partition(": use `")[2].rpartition("`")[0]
    assert shlex.split(said) == ["invertwin", "reconstruct", file]
    Path(file).write_text('task = "simulate"\n')
    assert call(monkeypatch, "check", file) == 2
    said = capsys.readouterr().err.partition("convert it: ")[2]
    assert shlex.split(said) == ["invertwin", "convert", file]
