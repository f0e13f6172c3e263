"""The benchmark beside Sionna RT in small: lists of paths are compared, ours come from a file."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from invertwin.scene import Object, Scene, Slab, box, save_scene_xml


def made(channels, kinds, delays, scale=1.0):
    amplitude = scale * np.ones((len(delays), 2, 2)) / (1 + np.arange(len(delays)))[:, None, None]
    return channels.PathList(np.array(kinds), np.array(delays), amplitude)


def test_lists_of_paths_are_compared(channels):
    ours = made(channels, [[0], [1], [2]], [1e-8, 2e-8, 3e-8])
    assert channels.compared(ours, ours) == {
        "paths": 3,
        "unmatched": 0,
        "delay_s": 0.0,
        "amplitude": 0.0,
    }
    late = made(channels, [[0], [1], [2]], [1e-8, 2e-8 + 1e-15, 3e-8], scale=1.001)
    found = channels.compared(ours, late)
    assert found["unmatched"] == 0
    assert found["delay_s"] == pytest.approx(1e-15)
    assert found["amplitude"] == pytest.approx(1e-3)
    # Another kind, another delay, and one too many.
    other = made(channels, [[0], [2], [2], [1]], [1e-8, 2e-8, 4e-8, 9e-8])
    assert channels.compared(ours, other)["unmatched"] == 2 + 3


def test_paths_that_are_too_weak_do_not_count(channels):
    some = made(channels, [[0], [1]], [1e-8, 2e-8])
    some.amplitude[1] *= 1e-7
    assert len(some.strong().delay) == 1


def test_our_paths_of_a_file(channels, tmp_path, monkeypatch):
    wall = Slab.itu("concrete", thickness=0.1)
    save_scene_xml(tmp_path / "room.xml", Scene({"room": Object(box((5.0, 4.0, 3.0)), wall)}))
    scenes = SimpleNamespace(scene=SimpleNamespace(room=tmp_path / "room.xml"))
    monkeypatch.setattr(channels, "import_module", lambda name: scenes)
    case = channels.Case("room", (1, 1, 1), (-1, 0, 0.5), (-2, -1, -1), (2, 1, 1), False)
    ours = channels.Ours(case, channels.spread(case, 3))
    assert len(channels.Ours(case, np.array([case.rx])).listed().delay) >= 7
    assert ours.differentiated() > 0
    assert set(ours.paths().rx.tolist()) == {0, 1, 2}
    assert torch.isfinite(ours.paths().delay).all()
