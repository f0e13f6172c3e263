"""The benchmark of dielectric solids in small."""

import json

from rich.console import Console


def test_blocks_and_balls_with_few_tubes_and_frequencies(solids):
    metrics = solids.measure((4.0,), 4, 31)
    assert metrics["block_error"] < 1e-9
    assert metrics["tubes_error"]["order 1_4"] < 0.01
    assert max(metrics["tubes_error"].values()) < 0.5
    assert abs(metrics["front_db"]["1.2"]) < 0.2
    assert abs(metrics["back_db"]["1.2"]) < 1.0
    json.dumps(metrics)
    console = Console(width=160, record=True)
    console.print(solids.table(metrics))
    assert "back_db.1.5" in console.export_text()
