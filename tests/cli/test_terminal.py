"""Tables in a terminal."""

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
