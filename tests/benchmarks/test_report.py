"""The page that the benchmarks share."""

import json

from rich.console import Console


def test_a_metric_is_held_to_its_limit(report):
    page = report.MetricTable("Title", {"ratio": (">=", 2.0), "b.share": ("<=", 0.2)})
    page.row("a.ratio", 2.0, ".1f", "[least]")
    page.row("b.ratio", 1.9, ".1f")
    page.row("b.share", 0.3, ".1f")
    page.row("a.share", 0.3, ".1f")
    page.row("c.ratio", None, ".1f")
    console = Console(width=100, record=True)
    console.print(page.grid)
    rows = [line.split("│")[1:-1] for line in console.export_text().splitlines() if "│" in line]
    assert [[cell.strip() for cell in row] for row in rows] == [
        ["a.ratio", "2.0", ">= 2 yes", "[least]"],
        ["b.ratio", "1.9", ">= 2 NO", ""],
        ["b.share", "0.3", "<= 0.2 NO", ""],
        ["a.share", "0.3", "", ""],
        ["c.ratio", "—", ">= 2 —", ""],
    ]


def test_metrics_are_written(report, tmp_path, capsys):
    page = report.MetricTable("Title", {})
    page.row("speed", 3.0, ".2f")
    report.write({"speed": 3.0}, page.grid, tmp_path / "new")
    assert json.loads((tmp_path / "new" / "metrics.json").read_text()) == {"speed": 3.0}
    assert "3.00" in capsys.readouterr().out
