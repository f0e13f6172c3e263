"""A scene as flat tables."""

import pytest

from invertwin.channel.rays.geometry import flatten
from invertwin.radar import PhysicsWarning
from invertwin.scene import RoughConductor, Scene
from invertwin.scene.shapes import box, plate, sphere
from scenes import thing


def test_facets_that_turn_by_more_than_a_lobe_are_warned_of():
    shiny = RoughConductor(rms_slope=0.03)
    coarse = Scene({"ball": thing(sphere(0.1, 2), material=shiny), "wall": thing(plate(1.0, 1.0))})
    with pytest.warns(PhysicsWarning, match=r"triangles of ball turn by 1\d° .* wide \(1\.7°\)"):
        flatten(coarse, 4e-3)
    flatten(Scene({"ball": thing(sphere(0.1, 5), material=shiny)}), 4e-3)
    flatten(Scene({"box": thing(box(0.2), material=shiny)}), 4e-3)
    flatten(Scene({"ball": thing(sphere(0.1, 2))}), 4e-3)
