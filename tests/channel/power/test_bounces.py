"""Paths of several bounces: the fused walk against its torch reference, its adjoint, and itself."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from invertwin.channel import Grid, Link, Sampling, deposit_power, trace_field, trace_power
from invertwin.errors import InputError
from invertwin.scene import (
    Cosine,
    Dielectric,
    Material,
    Mesh,
    Object,
    RefractingBody,
    Scene,
    Slab,
    box,
    plate,
    rotation_from_vector,
)
from oracles.deposit_by_paths import deposit_by_paths
from scenes import float64, link, occluder, relative, thing

GRID = Grid(0.4, 0.075, 60, u_start=-0.6, u_step=0.1, u_count=13)
COUNTS = Sampling(depth=1, samples=10_000, boundary_samples=3_000)
KINDS = ("opaque", "sheet", "body")


def leaves(bistatic: bool, kind: str) -> dict[str, Tensor]:
    """Everything that a map can be differentiated by, in two frames."""
    turns = [rotation_from_vector(float64(v)) for v in ([0.0, 0.05, 0.1], [0.2, 0.0, -0.1])]
    front = box((0.2, 0.4, 0.4)).vertices + float64([0.8, 0.05, 0.0])
    values = {
        "wall": occluder()["wall"].vertices,
        "front": front if kind == "body" else occluder()["occluder"].vertices,
        "tx": float64([[0.0, 0.0, 0.0], [-0.1, 0.2, 0.1]]),
        "rotations": torch.stack(turns),
        "permittivity": float64(3.0),
        "conductivity": float64(0.05),
        "rms_slope": float64(0.3),
    }
    if bistatic:
        values["rx"] = values["tx"] + float64([0.05, 0.3, 0.0])
    return {name: value.clone().requires_grad_() for name, value in values.items()}


def built(values: dict[str, Tensor], kind: str) -> tuple[Scene, Link]:
    """A wall, a floor that does not touch it, and something in front."""
    roughness: dict[str, Any] = {
        "rms_slope": values["rms_slope"],
        "scattering": 0.8,
        "lambertian": 0.5,
        "directive": 0.6,
    }
    medium = (values["permittivity"], values["conductivity"])
    rough = Dielectric(*medium, **roughness)
    material: Material = rough
    if kind == "sheet":
        material = Slab(*medium, thickness=0.01, **roughness)
    elif kind == "body":
        material = RefractingBody(*medium, **roughness)
    mesh = box((0.2, 0.4, 0.4)) if kind == "body" else occluder()["occluder"].mesh
    scene = Scene(
        {
            "wall": Object(Mesh(values["wall"], occluder()["wall"].mesh.faces), rough),
            "front": Object(Mesh(values["front"], mesh.faces), material),
            "floor": thing(plate(1.6, 1.4, divisions=2), (1.0, 0.1, -0.9), (0, 1.5, 0), rough),
        }
    )
    return scene, link(values["tx"], values.get("rx"), values["rotations"], Cosine(1.0))


def random_map(shape: tuple[int, ...]) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64)


def more_than_one(
    deposit: Callable[..., Tensor], *where: Any, sampling: Sampling, seed: int
) -> Tensor:
    """What paths of two points and more add to the map."""
    single = replace(sampling, depth=1)
    return deposit(*where, sampling=sampling, seed=seed) - deposit(
        *where, sampling=single, seed=seed
    )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("bistatic", [False, True], ids=["monostatic", "bistatic"])
def test_value_and_gradients_are_those_of_the_torch_reference(bistatic, kind):
    """At fixed visibility: explicit boundary paths stop at one bounce.

    Towards the critical angle the derivative of Snell's law grows without bound, and single
    precision with it: the seed is one whose few paths stay away from there.
    """
    values = leaves(bistatic, kind)
    where = *built(values, kind), GRID
    depth, seed = (5, 9) if kind == "body" else (3, 9)
    sampling = replace(COUNTS, depth=depth, boundary_samples=0, boundary=False)
    fused, slow = (
        more_than_one(deposit, *where, sampling=sampling, seed=seed)
        for deposit in (deposit_power, deposit_by_paths)
    )
    assert float(slow.detach().sum()) > 0
    assert relative(fused, slow) < 1e-3
    weights = random_map(slow.shape)
    found, truth = (
        torch.autograd.grad((weights * out).sum(), list(values.values())) for out in (fused, slow)
    )
    for name, a, b in zip(values, found, truth, strict=True):
        assert b.any(), name
        assert relative(a, b) < 2e-3, name


@pytest.mark.parametrize(
    ("bistatic", "kind"),
    [
        (True, "opaque"),
        (False, "sheet"),
        pytest.param(True, "sheet", marks=pytest.mark.slow),
        pytest.param(False, "body", marks=pytest.mark.slow),
    ],
)
def test_forward_and_reverse_mode_agree(bistatic, kind):
    """Boundary paths of both families included, and every one of them is there."""
    values = leaves(bistatic, kind)
    sampling = replace(COUNTS, depth=3)
    out = deposit_power(*built(values, kind), GRID, sampling=sampling, seed=3)
    weights = random_map(out.shape)
    pulled = torch.autograd.grad((weights * out).sum(), list(values.values()))
    generator = torch.Generator().manual_seed(1)
    back = size = torch.zeros((), dtype=torch.float64)
    with forward_ad.dual_level():
        dual = {}
        for (name, value), bar in zip(values.items(), pulled, strict=True):
            tangent = torch.randn(value.shape, generator=generator, dtype=torch.float64)
            tangent = tangent / (bar * tangent).sum().abs()  # all of them count alike
            dual[name] = forward_ad.make_dual(value.detach(), tangent)
            back, size = back + (bar * tangent).sum(), size + 1
        moved = deposit_power(*built(dual, kind), GRID, sampling=sampling, seed=3)
        pushed = forward_ad.unpack_dual(moved).tangent
    assert pushed is not None
    size = torch.maximum(size, (weights * pushed.abs()).sum())
    assert float(((weights * pushed).sum() - back).abs() / size) < 1e-5
    for less in (replace(sampling, boundary=False), replace(sampling, interior_edges=False)):
        out = deposit_power(*built(values, kind), GRID, sampling=less, seed=3)
        without = torch.autograd.grad((weights * out).sum(), values["front"])[0]
        assert relative(without, pulled[1]) > 1e-4


@pytest.mark.parametrize(
    "kind", [pytest.param(k, marks=() if k == "sheet" else pytest.mark.slow) for k in KINDS]
)
def test_chunks_change_nothing(kind):
    """The least budget takes several chunks for the edge points of each family, too."""
    values = leaves(True, kind)
    results = []
    for budget in (1e9, 200_000, 30_000):
        out = deposit_power(
            *built(values, kind),
            GRID,
            sampling=replace(COUNTS, depth=3, memory_budget=budget),
            seed=3,
        )
        # Weights that differ between bins would leave derivatives that nearly cancel.
        gradients = torch.autograd.grad(out.sum(), list(values.values()))
        results.append([out, *gradients])
    for whole, *parts in zip(*results, strict=True):
        for pieces in parts:
            assert relative(pieces, whole) < 1e-5


def test_depth_adds_to_what_is_there():
    """Longer paths leave shorter ones alone: maps of rising depth never lose power."""
    scene, antennas = built(leaves(True, "opaque"), "opaque")
    with torch.no_grad():
        maps = [
            deposit_power(
                scene, antennas, GRID, sampling=replace(COUNTS, depth=d, boundary=False), seed=3
            )
            for d in range(1, 6)
        ]
    for less, more in pairwise(maps):
        assert (more - less > -1e-6 * more.max()).all()
    gains = [float((more - less).sum()) for less, more in pairwise(maps)]
    assert all(later < earlier for earlier, later in pairwise(gains))


@pytest.mark.parametrize("depth", [0, 17])
def test_a_depth_out_of_range_is_named(depth):
    with pytest.raises(InputError, match=rf"expected depth of at (least 1|most 16), got {depth}"):
        deposit_power(occluder(), link(), GRID, sampling=replace(COUNTS, depth=depth), seed=3)


def hidden(shift: Tensor) -> Scene:
    """A small plate behind a large one, which sees a side wall that the radar sees too."""
    item = thing(plate(0.3, 0.3), (2.0, 0.0, 0.0), (0.0, 0.0, 0.5))
    return Scene(
        {
            "screen": thing(plate(0.8, 0.8), (1.0, 0.0, 0.0)),
            "side": thing(plate(2.0, 1.0), (1.6, 1.4, 0.0), (0.0, 0.0, math.pi / 2)),
            "item": Object(Mesh(item.vertices + shift, item.mesh.faces), item.material),
        }
    )


@pytest.mark.parametrize("rx", [None, ((0.0, 0.01, 0.0),)], ids=["monostatic", "bistatic"])
def test_what_is_wholly_hidden_has_no_gradient_until_something_shows_it(rx):
    shift = float64([0.0, 0.0, 0.0]).requires_grad_()
    for depth in (1, 2, 3):
        out = deposit_power(
            hidden(shift), link(rx=rx), GRID, sampling=replace(COUNTS, depth=depth), seed=3
        )
        assert out.any()
        gradient = torch.autograd.grad(out.sum(), shift)[0]
        # There and back by way of the side wall takes three points; two see it with one antenna.
        assert bool(gradient.any()) == (depth == 3), depth


def test_nothing_to_see_is_zeros_at_any_depth():
    shift = float64([0.0, 0.0, 0.0]).requires_grad_()
    behind = link(rotations=torch.diag(float64([-1.0, -1.0, 1.0]))[None], pattern=Cosine(1.0))
    out = deposit_power(hidden(shift), behind, GRID, sampling=replace(COUNTS, depth=3), seed=3)
    assert not out.any()
    assert not torch.autograd.grad(out.sum(), shift)[0].any()


def opened(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, mesh.faces[1:])


def turned(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, mesh.faces.flip(1))


def body_map(mesh: Mesh) -> Tensor:
    body = thing(mesh, (1.0, 0.0, 0.0), material=RefractingBody(2.5))
    sampling = replace(COUNTS, depth=2)
    return deposit_power(Scene({"block": body}), link(), GRID, sampling=sampling, seed=3)


def test_a_body_without_an_inside_is_refused():
    with pytest.raises(InputError, match="refracting body block, got an open one"):
        body_map(opened(box(0.3)))


def test_a_body_may_be_wound_either_way():
    torch.testing.assert_close(body_map(turned(box(0.3))), body_map(box(0.3)))


def test_explicit_paths_refuse_what_they_cannot_do():
    shift = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)
    with pytest.raises(InputError, match="expected explicit paths of one bounce without sheets"):
        trace_power(occluder(), link(shift), sampling=replace(COUNTS, depth=2), seed=3)
    board = occluder(occluder=Slab(2.5, thickness=0.01))
    with pytest.raises(InputError, match="expected explicit paths of one bounce without sheets"):
        trace_power(board, link(shift), sampling=COUNTS, seed=3)
    with pytest.raises(InputError, match="no geometry derivative of rough field paths"):
        trace_field(
            occluder(),
            link(shift),
            sampling=Sampling(depth=2, samples=100_000, boundary_samples=0, points_per_m2=100.0),
            seed=0,
        )
    moving = occluder().replace("occluder", velocity=float64([0.0, 1.0, 0.0]))
    with pytest.raises(InputError, match="expected depth 1 for objects in motion, got 2"):
        trace_field(
            moving,
            link(),
            sampling=Sampling(depth=2, samples=100_000, boundary_samples=0, points_per_m2=100.0),
            seed=0,
        )
    with pytest.raises(InputError, match="expected depth 1 for objects in motion, got 2"):
        trace_power(moving, link(), sampling=replace(COUNTS, depth=2), seed=3)
