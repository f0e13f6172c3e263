"""The benchmark of dielectric solids in small."""

import json

from rich.console import Console


def test_blocks_and_bodies_with_few_tubes_frequencies_and_aspects(solids):
    metrics = solids.measure((4.0,), 4, 31, aspects=4)
    assert metrics["block_error"] < 1e-9
    assert metrics["tubes_error"]["order 1_4"] < 0.01
    assert max(metrics["tubes_error"].values()) < 0.5
    assert abs(metrics["front_db"]["1.2"]) < 0.2
    assert abs(metrics["back_db"]["1.2"]) < 1.0
    assert 0.98 < metrics["energy"] < 1.0
    assert 0.6 < sum(metrics["power_out"].values()) < 1.0
    assert metrics["mesh_mean_db"] < 1.0
    json.dumps(metrics)
    console = Console(width=160, record=True)
    console.print(solids.table(metrics))
    assert "back_db.1.5" in console.export_text()
