"""Figures of rooms from above."""

import torch

from invertwin import plotting
from invertwin.scene import Object, PerfectConductor, Scene, box, rigid

CUPBOARD = box((1.0, 0.5, 2.0))


def test_fits_of_a_transmitter_begin_and_end_on_the_plan():
    pose = rigid(translation=[2.0, 1.0, 1.0])
    scene = Scene({"cupboard": Object(CUPBOARD, PerfectConductor(), pose)})
    fits = torch.tensor(
        [[[0.0, 0.0, 1.0], [3.0, 4.0, 1.5]], [[1.0, 5.0, 1.0], [3.1, 4.1, 1.5]]]
    ).double()
    places = {"truth": torch.tensor([[3.0, 4.1, 1.5]]).double(), "found": fits[:1, 1]}
    (axes,) = plotting.transmitter_fits(scene, 1.2, places, fits).axes
    shown = {line.get_label(): line.get_xydata().tolist() for line in axes.lines}
    assert shown["starts"] == [[0.0, 0.0], [1.0, 5.0]]
    assert [round(x, 3) for x in shown["truth"][0]] == [3.0, 4.1]
    walls = axes.collections[0].get_segments()
    corners = {(round(float(x), 6), round(float(y), 6)) for line in walls for x, y in line}
    assert {(1.5, 0.75), (2.5, 1.25)} <= corners
