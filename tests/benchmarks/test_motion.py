"""The benchmark of moving frames in small."""

import pytest


@pytest.mark.slow
def test_every_metric_is_there(motion, monkeypatch):
    monkeypatch.setattr(motion, "LOOPS", 24)
    monkeypatch.setattr(motion, "SLOW", 2)
    monkeypatch.setattr(motion, "SAMPLING", motion.iw.Sampling(depth=1, points_per_m2=100.0))
    found = motion.measured()
    assert found["frame_seconds"] > 0
    assert found["frame_seconds_ratio"] > 1
    assert 0 < found["difference"] < 0.01
    assert found["map_difference_db"] < -40


def test_the_person_walks_and_swings_legs(motion):
    first, later = motion.walking(0.0)["person"], motion.walking(0.1)["person"]
    way = later.vertices.mean(0) - first.vertices.mean(0)
    assert float(way[0]) == pytest.approx(-0.14, abs=0.03)
    assert float((later.mesh.vertices - first.mesh.vertices).norm(dim=1).max()) > 0.1
