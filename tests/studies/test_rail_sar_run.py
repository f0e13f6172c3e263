"""The measured recording from its run file to the report, and what the report says limits it."""

import pytest
import torch

from cli.small import call, read_metrics
from invertwin.capture import Capture, calibrate, locate
from invertwin.capture.readers.radar_fields import to_data_array
from invertwin_studies.recordings import rail_sar


@pytest.mark.slow
def test_run_file_finds_the_second_reflector(repository, data_folder, tmp_path, monkeypatch):
    text = (repository / "experiments" / "rail_sar.toml").read_text()
    run_file = tmp_path / "rail_sar.toml"
    # Three starts of half the steps show what ten of all show: see the run file itself.
    run_file.write_text(
        text.replace("count = 10", "count = 3").replace("steps = 200", "steps = 100")
    )
    monkeypatch.setenv("INVERTWIN_DATA", str(data_folder))
    assert call(monkeypatch, "reconstruct", run_file, "-o", tmp_path / "out") == 0
    metrics = read_metrics(tmp_path / "out")
    assert metrics["heldout_error_m"] <= 0.18
    assert metrics["heldout_error_m"] <= metrics["backprojection_error_m"] <= 0.18
    assert metrics["spread_m"] <= 0.03
    assert metrics["calibration"]["range_bias_m"] == pytest.approx(0.463, abs=2e-3)
    assert metrics["calibration"]["clock_offset_s"] == pytest.approx(9.216, abs=2e-3)
    # The figures of the note.
    assert metrics["backprojection_distance_m"] == pytest.approx(5.07, abs=5e-3)
    assert metrics["surveyed_distance_m"] == pytest.approx(4.91, abs=5e-3)
    report = (tmp_path / "out" / "report.html").read_text()
    assert "Noise does not limit the result." in report
    assert "no evidence that either is better" in report


def test_an_offset_across_the_rail_is_what_calibration_cannot_see(data_folder):
    """With the radar 0.25 m further out and another bias all focuses better: as the note says."""
    capture = rail_sar.read(data_folder / "rail_sar")
    assert capture.survey is not None
    assert capture.track is not None
    known, held_out = capture.survey
    out = torch.tensor([0.25, 0.0, 0.0], dtype=torch.float64)
    moved = Capture(
        capture.dataset.assign(
            position=to_data_array(("frame", "axis"), capture.radar().positions + out, "m"),
            track_position=to_data_array(
                ("track_time", "axis"), capture.track.positions + out, "m"
            ),
        )
    )
    for _ in range(3):  # the search reaches 0.1 m at a time
        moved = calibrate(moved, known)
    assert moved.range_bias == pytest.approx(0.71, abs=5e-3)
    assert float((locate(moved, known) - known).norm()) < 0.01
    assert float((locate(moved, held_out) - held_out).norm()) == pytest.approx(0.115, abs=3e-3)
