"""Two objects in one place that is seen."""

import math
import warnings
from typing import Any

import pytest
import torch

from invertwin.channel.rays import coplanar
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.coplanar import warn_coplanar_surfaces
from invertwin.channel.rays.ray_scene import RayScene
from invertwin.channel.rays.scene_tables import flatten
from invertwin.errors import PhysicsWarning
from invertwin.scene import (
    Mesh,
    Object,
    RoughConductor,
    RoughDielectric,
    Scene,
    Slab,
    box,
    plate,
    rigid,
)
from scenes import WAVELENGTH, float64, link, thing

METAL, PAINT = RoughConductor(scattering=1.0), RoughDielectric(4.0)
FLAT = (0.0, math.pi / 2, 0.0)  # a plate that lies


def told(*, antennas: Any = ((0.0, 0.0, 1.0),), moving: Any = "", **objects: Any) -> bool:
    """Whether a scene gives a warning that names the first two objects."""
    if moving:
        item = objects[moving]
        objects[moving] = Object(item.mesh, item.material, item.transform.clone().requires_grad_())
    with tracing(), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        rays = RayScene(flatten(Scene(objects), WAVELENGTH), link(tuple(map(tuple, antennas))))
        warn_coplanar_surfaces(rays)
    one, other = list(objects)[:2]
    for warning in caught:
        assert warning.category is PhysicsWarning
        assert str(warning.message).startswith(f"{one} and {other} lie in one plane, in a place")
    return bool(caught)


def floor(divisions: int = 1) -> Object:
    return thing(plate(4.0, 4.0, divisions=divisions), (2.0, 0.0, 0.0), FLAT, PAINT)


def rug(height: float, divisions: int = 1, at: tuple[float, float] = (0.3, 2.1)) -> Object:
    return thing(plate(0.6, 0.4, divisions=divisions), (at[1], at[0], height), FLAT, METAL)


@pytest.mark.parametrize("divisions", [(1, 1), (12, 1), (1, 12), (30, 25)])
def test_a_rug_in_the_plane_of_the_floor_is_told(divisions):
    pieces = floor(divisions[0])
    assert told(floor=pieces, rug=rug(0.0, divisions[1]))
    assert told(floor=pieces, rug=rug(1e-7, divisions[1]))
    assert not told(floor=pieces, rug=rug(1e-4, divisions[1]))
    assert not told(floor=pieces, rug=rug(0.0, divisions[1], at=(4.0, 2.1)))


def test_whatever_the_plane_and_the_distance():
    turn = (0.2, 0.4, 0.3)
    for scale in (1.0, 300.0):
        wall = thing(plate(2 * scale, 2 * scale), (2 * scale, 0.0, 0.0), turn, PAINT)
        sign = thing(plate(0.5 * scale, 0.3 * scale), (2 * scale, 0.0, 0.0), turn, METAL)
        assert told(wall=wall, sign=sign)
        pose = sign.transform.clone()
        pose[:3, 3] -= 1e-4 * scale * pose[:3, 0]
        assert not told(wall=wall, sign=Object(sign.mesh, METAL, pose))


def test_what_makes_no_difference_is_not_told():
    """Both at rest and of one material; to move one of them makes a difference."""
    same = Object(rug(0.0).mesh, PAINT, rug(0.0).pose)
    assert not told(floor=floor(), rug=same)
    assert told(floor=floor(), rug=same, moving="rug")
    assert told(floor=floor(), rug=same, moving="floor")


def test_what_is_hidden_is_not_told():
    """The underside of a box on the floor, two boxes side by side, a rug under a box."""
    chest = thing(box((0.5, 0.5, 0.4)), (2.0, 0.0, 0.2), material=METAL)
    assert not told(floor=floor(), chest=chest, moving="chest")
    # From below a ray meets either.
    assert told(floor=floor(), chest=chest, antennas=[(0.0, 0.0, -1.0)])
    next_one = thing(box((0.5, 0.5, 0.4)), (2.0, 0.5, 0.2), material=PAINT)
    assert not told(chest=chest, next_one=next_one, moving="chest")
    assert not told(floor=floor(), rug=rug(0.0, at=(0.0, 2.0)), chest=thing(
        box((0.9, 0.9, 0.4)), (2.0, 0.0, 0.21), material=METAL
    ))  # fmt: skip


def test_a_contact_that_is_seen_through_sheets_is_told():
    """Below a box of sheets, but not below one that only stands on a sheet."""
    glass = Slab(2.5, thickness=0.004)
    clear = thing(box((0.5, 0.5, 0.4)), (2.0, 0.0, 0.2), material=glass)
    solid = thing(box((0.5, 0.5, 0.4)), (2.0, 0.0, 0.2), material=METAL)
    pane = Object(floor().mesh, glass, floor().pose)
    assert told(floor=floor(), chest=clear, moving="chest")
    assert told(floor=pane, chest=clear, moving="chest")
    assert told(floor=pane, chest=clear, moving="floor")
    assert not told(floor=pane, chest=solid, moving="chest")
    lifted = thing(box((0.5, 0.5, 0.4)), (2.0, 0.0, 0.201), material=glass)
    assert not told(floor=floor(), chest=lifted, moving="chest")
    # Their values are right, and a lid hides them.
    assert not told(floor=floor(), chest=clear)
    lid = thing(box((0.9, 0.9, 0.6)), (2.0, 0.0, 0.31), material=METAL)
    assert not told(floor=floor(), chest=clear, lid=lid, moving="chest")


def test_only_what_has_moved_is_looked_at_again(monkeypatch):
    asked = []
    true = coplanar._find_visible_pairs  # pyright: ignore[reportPrivateUsage]

    def spy(rays, pairs):
        asked.append(pairs.sum().item())
        return true(rays, pairs)

    monkeypatch.setattr(coplanar, "_find_visible_pairs", spy)
    items = {"floor": floor(), "rug": rug(0.0), "box": thing(box(0.2), (2.0, -1.0, 0.5))}
    lifted = Object(items["rug"].mesh, METAL, rug(0.01).pose)
    moved = Object(items["box"].mesh, PAINT, rigid(translation=(2.0, -1.0, 0.6)))
    assert told(**items)
    assert told(**items)
    assert told(**(items | {"box": moved}))
    assert not told(**(items | {"box": moved, "rug": lifted}))
    assert told(**items)
    # The rug with both others, each way; nothing; the box with it; the rug; both.
    assert asked == [4, 2, 4, 4]


def test_any_antenna_that_sees_it_counts():
    for places, seen in (([(0.0, 0.0, 1.0)], False), ([(0.0, 0.0, 1.0), (1.0, 0.0, 1.0)], True)):
        screen = thing(plate(6.0, 6.0), (0.5, 0.0, 0.0))
        pair = {"floor": floor(), "rug": rug(0.0, at=(0.0, 2.0))}
        assert told(**pair, screen=screen, antennas=places) == seen


def test_triangles_that_cross_like_a_star_overlap():
    def triangle(material: RoughConductor | RoughDielectric, turned: float) -> Object:
        angles = float64([0.0, 2.0, 4.0]) * math.pi / 3 + turned
        corners = torch.stack([torch.full((3,), 2.0), angles.cos(), angles.sin()], 1).double()
        return Object(Mesh(corners, torch.tensor([[0, 1, 2]])), material)

    assert told(one=triangle(PAINT, 0.0), other=triangle(METAL, math.pi / 3))


def test_scenes_of_a_batch_are_told_by_their_own_antennas():
    from invertwin.channel import Grid, Sampling
    from invertwin.channel.power.deposit import deposit_batch

    shift = rigid(translation=(0.0, 0.1, 0.0))
    good, bad = (Scene({"floor": floor(), "rug": rug(h)}) for h in (0.01, 0.0))
    moved = Scene(
        {n: Object(o.mesh, o.material, shift @ o.transform) for n, o in good.objects.items()}
    )
    grid, sampling = Grid(0.5, 0.1, 40), Sampling(depth=1, samples=1000)
    deposit_batch([good, moved], link(((0.0, 0.0, 1.0),)), grid, sampling=sampling, seed=1)
    with pytest.warns(PhysicsWarning, match="floor of scene 1 and rug of scene 1 lie in one plane"):
        deposit_batch([good, bad], link(((0.0, 0.0, 1.0),)), grid, sampling=sampling, seed=1)
