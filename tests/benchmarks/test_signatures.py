"""The benchmark of a car's signature in small."""

import json

import pytest
from rich.console import Console


@pytest.mark.slow
def test_a_car_by_few_tubes_and_frequencies(signatures):
    metrics = signatures.measure(
        (76.5e9, 77.5e9, 2), others=(0.25,), converged=1.0, facets=(64, 60), depth=3
    )
    assert metrics["triangles"] >= 25_000
    assert 1e5 < metrics["tubes"] < 3e5
    assert metrics["patches"]["1"] > metrics["patches"]["3"] > 0
    assert metrics["profile_error_db"] == -float("inf")  # both are one tube per wavelength
    assert -20 < metrics["converging_db"]["0.25"] < -5
    assert 0 < metrics["tracing_share"] < 1
    assert metrics["duct"]["triangles"] == 64 * 121
    assert metrics["duct"]["seconds"] > 0
    json.dumps(metrics)
    console = Console(width=160, record=True)
    console.print(signatures.table(metrics))
    assert "profile_error_db" in console.export_text()
