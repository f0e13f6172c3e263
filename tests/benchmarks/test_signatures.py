"""The benchmark of a car's signature in small."""

import json

import pytest
from rich.console import Console


@pytest.mark.slow
def test_a_car_by_few_tubes_and_frequencies(signatures):
    metrics = signatures.measure((76.5e9, 77.5e9, 2), others=(0.25,), converged=1.0)
    assert metrics["triangles"] >= 25_000
    assert 2e5 < metrics["tubes"] < 3e5
    assert metrics["profile_error_db"] == -float("inf")  # both are one tube per wavelength
    assert metrics["converging_db"]["0.25"] > -20
    assert 0 < metrics["tracing_share"] < 1
    json.dumps(metrics)
    console = Console(width=160, record=True)
    console.print(signatures.table(metrics))
    assert "profile_error_db" in console.export_text()
