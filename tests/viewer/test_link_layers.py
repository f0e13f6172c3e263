"""Antennas, paths and levels of links as layers."""

import numpy as np
import pytest
import torch

from invertwin.links import (
    MapPlane,
    Metasurface,
    PropagationSettings,
    ReceiverPoints,
    Transmitters,
)
from invertwin.models.radio import RadioMap
from invertwin.scene import Object, PerfectConductor, RoughDielectric, Scene, plate, rigid
from invertwin.viewer import DisplayLayer, link_layers

SENSOR = Transmitters(torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64))
SETTINGS = PropagationSettings(5e9, depth=1)


def layers_of(scene: Scene, model: RadioMap, levels=None) -> dict[str, DisplayLayer]:
    return {layer.name: layer for layer in link_layers(scene, SENSOR, model, levels)}


def floor(material) -> Scene:
    level = rigid(torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]).double())
    return Scene({"floor": Object(plate(20.0, 20.0), material, level)})


def test_paths_begin_and_end_at_antennas_and_meet_the_floor_in_the_middle():
    receivers = ReceiverPoints(torch.tensor([[4.0, 0.0, 1.0]], dtype=torch.float64))
    found = layers_of(floor(PerfectConductor()), RadioMap(receivers, SETTINGS))
    assert list(found) == ["transmitters", "receivers", "paths: line of sight", "paths: reflection"]
    assert len({layer.color for layer in found.values()}) == 4
    assert found["transmitters"].points == pytest.approx(np.array([[0.0, 0, 1]]))
    assert found["receivers"].points == pytest.approx(np.array([[4.0, 0, 1]]))
    direct = found["paths: line of sight"].points
    assert direct == pytest.approx(np.array([[0.0, 0, 1], [4, 0, 1]]))
    bent = found["paths: reflection"].points
    assert bent == pytest.approx(np.array([[0.0, 0, 1], [2, 0, 0], [2, 0, 0], [4, 0, 1]]), abs=1e-6)


def test_only_the_strongest_paths_of_a_kind_are_drawn():
    """From the far ceiling comes a hundredth of the power from the floor: it is left out."""
    receivers = ReceiverPoints(torch.tensor([[4.0, 0.0, 1.0]], dtype=torch.float64))
    low = floor(PerfectConductor())["floor"]
    high = low.transform.clone()
    high[2, 3] = 25.0
    both = Scene({"floor": low, "ceiling": Object(low.mesh, low.material, high)})
    bent = layers_of(both, RadioMap(receivers, SETTINGS))["paths: reflection"].points
    assert bent == pytest.approx(np.array([[0.0, 0, 1], [2, 0, 0], [2, 0, 0], [4, 0, 1]]), abs=1e-6)


def test_a_scene_without_such_paths_shows_its_antennas():
    receivers = ReceiverPoints(torch.tensor([[4.0, 0.0, 1.0]], dtype=torch.float64))
    found = layers_of(floor(RoughDielectric(4.0)), RadioMap(receivers, SETTINGS))
    assert {"transmitters", "receivers"} <= set(found)


def test_cells_are_in_the_band_of_their_level():
    plane = MapPlane.horizontal([0.0, 0.0], [4.0, 2.0], 0.5, 0.5)
    levels = np.arange(32.0).reshape(plane.shape)
    levels[0, 0] = np.nan
    found = layers_of(floor(PerfectConductor()), RadioMap(plane, SETTINGS), levels)
    bands = {n.removeprefix("levels/"): x for n, x in found.items() if x.group == "levels"}
    assert len(bands) == 12
    assert list(bands)[-1].endswith(" to 31 dBm")  # the highest
    assert sum(len(layer.points) for layer in bands.values()) == 4 * 31
    centres = plane.centres.reshape(-1, 3).numpy()
    for name, layer in bands.items():
        assert layer.band is not None
        assert name == f"{layer.band[0]:.4g} to {layer.band[1]:.4g} {layer.unit}"
        middles = layer.points.reshape(-1, 4, 3).mean(1)
        away = np.linalg.norm(middles[:, None] - centres[None], axis=2)
        assert away.min(1).max() < 1e-6
        own = levels.ravel()[away.argmin(1)]
        assert layer.band[0] <= own.min()
        assert own.max() <= layer.band[1]
        first, second, third = layer.points[layer.faces].transpose(1, 0, 2)
        areas = np.linalg.norm(np.cross(second - first, third - first), axis=1) / 2
        assert areas == pytest.approx(0.125)


@pytest.mark.parametrize(("spacing", "drawn"), [(0.1, 0.1), (0.001, 0.05)])
def test_cells_of_a_metasurface_have_the_colour_of_their_phase(spacing, drawn):
    # It stands 2 m from the transmitter and looks along y; a small one is drawn 0.2 m wide.
    axes = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).double()
    phase = torch.tensor([[0.1, 0.2], [3.0, 3.3], [-1.5, -1.5], [0.1, -3.0]]).double()
    panel = Metasurface(torch.tensor([0.0, -2.0, 1.0]).double(), axes, phase, spacing)
    receivers = ReceiverPoints(torch.tensor([[1.0, 0.0, 1.0]], dtype=torch.float64))
    settings = PropagationSettings(5e9, depth=0, panels=[panel])
    found = layers_of(floor(PerfectConductor()), RadioMap(receivers, settings))
    bands = {n.split("/")[1]: x for n, x in found.items() if x.group.startswith("metasurface")}
    counts = {name: len(layer.faces) // 2 for name, layer in bands.items()}
    # 3.3 rad are -171 degrees, as -3.0 rad are -172.
    assert counts == {"-180 to -150 °": 2, "-90 to -60 °": 2, "0 to 30 °": 3, "150 to 180 °": 1}
    assert len({layer.color for layer in bands.values()}) == 4
    (single,) = (layer for name, layer in bands.items() if name == "150 to 180 °")
    # Of the second row of four along y, which is -x in the world; the lower one of two.
    middle = np.array([0.5 * drawn, -2.0, 1.0 - 0.5 * drawn])
    assert single.points.mean(0) == pytest.approx(middle, abs=1e-6)
    assert np.ptp(single.points, axis=0) == pytest.approx([0.9 * drawn, 0, 0.9 * drawn], abs=1e-6)
    assert found["paths: metasurface"].points[1] == pytest.approx([0.0, -2.0, 1.0])


def test_of_very_many_receivers_some_are_drawn():
    receivers = ReceiverPoints(
        torch.rand(1000, 3, generator=torch.Generator().manual_seed(1)).double()
    )
    found = layers_of(floor(PerfectConductor()), RadioMap(receivers, SETTINGS))
    assert len(found["receivers"].points) == 63
