"""Silhouettes of any mesh, and the derivative of shadows that move."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from invertwin.channel import Grid, Link, Sampling, deposit_power
from invertwin.channel.rays.topology import edge_tables
from invertwin.errors import InputError, PhysicsWarning
from invertwin.scene import Mesh, Object, RoughDielectric, Scene, box, plate, sphere
from invertwin.scene.mesh_topology import close_cracks
from scenes import GRID, WAVELENGTH, float64, link, occluder, relative, shift_error, thing

WALL = thing(plate(2.0, 2.0, divisions=2), (2, 0, 0))
ACROSS = Grid(1.5, 1.0, 2, u_start=-0.6, u_step=0.1, u_count=13)
COUNTS = Sampling(depth=1, samples=4_000, boundary_samples=40_000)


def shadow_rate(screens: dict[str, Mesh], antennas: Link, boundary: bool = True) -> Tensor:
    """∂map/∂y of screens that slide together in front of the wall."""
    shift = torch.zeros((), dtype=torch.float64, requires_grad=True)
    offset = torch.stack([1 + 0 * shift, 0.1 + shift, 0.05 + 0 * shift])
    scene = Scene(
        {"wall": WALL}
        | {
            name: Object(Mesh(mesh.vertices + offset, mesh.faces), RoughDielectric(4.0))
            for name, mesh in screens.items()
        }
    )
    out = deposit_power(
        scene, antennas, ACROSS, sampling=replace(COUNTS, boundary=boundary), seed=1
    )
    # One column of the Jacobian of a map is cheapest as two reverse passes over its bins.
    rows = [torch.autograd.grad(out[0, 0, u, 0], shift, retain_graph=True)[0] for u in range(13)]
    return torch.stack(rows)


def plain() -> Mesh:
    return plate(0.4, 0.3)


def halves(mesh: Mesh) -> Mesh:
    """The same triangles with vertices of their own: every edge twice."""
    vertices = mesh.vertices[mesh.faces].reshape(-1, 3)
    return Mesh(vertices, torch.arange(len(vertices)).reshape(-1, 3))


def mirrored(mesh: Mesh) -> Mesh:
    """One triangle wound the other way."""
    faces = mesh.faces.clone()
    faces[0] = faces[0].flip(0)
    return Mesh(mesh.vertices, faces)


def finned(mesh: Mesh) -> Mesh:
    """A third triangle on the diagonal, behind the plate: a non-manifold edge."""
    faces = mesh.faces
    shared = sorted(set(faces[0].tolist()) & set(faces[1].tolist()))
    apex = mesh.vertices[shared].mean(0) + float64([0.1, 0.02, 0.05])
    vertices = torch.cat([mesh.vertices, apex[None]])
    fin = torch.tensor([[*shared, len(mesh.vertices)]])
    return Mesh(vertices, torch.cat([faces, fin]))


def slivered(mesh: Mesh) -> Mesh:
    """A triangle of no area along one edge."""
    middle = mesh.vertices[mesh.faces[0, :2]].mean(0)
    vertices = torch.cat([mesh.vertices, middle[None]])
    sliver = torch.tensor([[int(mesh.faces[0, 0]), int(mesh.faces[0, 1]), len(mesh.vertices)]])
    return Mesh(vertices, torch.cat([mesh.faces, sliver]))


@pytest.mark.parametrize("change", [halves, mirrored, finned])
def test_meshing_does_not_change_the_shadow(change):
    truth = shadow_rate({"screen": plain()}, link())
    found = shadow_rate({"screen": change(plain())}, link())
    interior = shadow_rate({"screen": plain()}, link(), boundary=False)
    assert relative(found, truth) < 0.06
    assert relative(interior, truth) > 0.2


def test_two_objects_that_touch_are_one_screen():
    right, left = plate(0.2, 0.3), plate(0.2, 0.3)
    parts = {
        "right": Mesh(right.vertices - float64([0, 0.1, 0]), right.faces),
        "left": Mesh(left.vertices + float64([0, 0.1, 0]), left.faces),
    }
    assert relative(shadow_rate(parts, link()), shadow_rate({"screen": plain()}, link())) < 0.06


def test_objects_that_start_at_one_place_may_part():
    """Equal vertices of two objects are never one: the second screen keeps its own shadow."""

    def rate(start: float) -> Tensor:
        shift = torch.tensor(start, dtype=torch.float64, requires_grad=True)
        still, moving = PARTED
        place = torch.stack([1 + 0 * shift, shift, 0 * shift])
        screen = Object(Mesh(moving.vertices + place, moving.faces), RoughDielectric(4.0))
        scene = Scene({"wall": WALL, "still": thing(still, (1, 0, 0)), "moving": screen})
        out = deposit_power(scene, link(), ACROSS, sampling=COUNTS, seed=1)
        return torch.stack(
            [torch.autograd.grad(out[0, 0, u, 0], shift, retain_graph=True)[0] for u in range(13)]
        )

    PARTED = plain(), plain()
    with pytest.warns(PhysicsWarning, match="still and moving lie in one plane"):
        rate(0.0)
    found = rate(0.45)
    PARTED = plain(), plain()
    assert relative(found, rate(0.45)) < 1e-3


def test_edges_of_a_mesh_with_split_vertices():
    cube = box(1.0)
    for mesh in (cube, halves(cube)):
        edges, opposite, _ = edge_tables(
            *close_cracks(mesh.vertices.numpy(), mesh.faces.numpy())[1:3]
        )
        assert len(edges) == 18
        assert opposite.shape == (18, 2)
        assert (opposite >= 0).all()
    edges, opposite, _ = edge_tables(
        *close_cracks(plain().vertices.numpy(), plain().faces.numpy())[1:3]
    )
    assert sorted((opposite >= 0).sum(1).tolist()) == [1, 1, 1, 1, 2]
    _, opposite, _ = edge_tables(
        *close_cracks(finned(plain()).vertices.numpy(), finned(plain()).faces.numpy())[1:3]
    )
    assert opposite.shape[1] == 3


def test_edges_of_a_mesh_that_is_a_point():
    edges, opposite, _ = edge_tables(*close_cracks(np.zeros((3, 3)), np.array([[0, 1, 2]]))[1:3])
    assert len(edges) == 0
    assert len(opposite) == 0


def test_separate_antennas_tend_to_shared_visibility():
    """Two boundary terms, each weighted by the other's visibility, become the one."""
    shared = shadow_rate({"screen": plain()}, link())
    gaps = []
    for distance in (0.3, 0.03, 0.003):
        half = float64([[0.0, 0.5 * distance, 0.0]])
        apart = shadow_rate({"screen": plain()}, link(-half, half))
        gaps.append(relative(apart, shared))
    assert gaps[2] < 0.06
    assert gaps[0] > 2 * gaps[2]


def test_a_later_call_does_not_disturb_an_earlier_one():
    """The ray scene is shared between calls: a derivative needs its own geometry back."""
    shift = torch.zeros((), dtype=torch.float64, requires_grad=True)
    faces = plain().faces

    def at(x: float) -> Tensor:
        place = torch.stack([1 + 0 * shift, x + shift, 0.05 + 0 * shift])
        screen = Object(Mesh(plain().vertices + place, faces), RoughDielectric(4.0))
        scene = Scene({"wall": WALL, "screen": screen})
        return (
            deposit_power(
                scene, link(), ACROSS, sampling=replace(COUNTS, memory_budget=20_000), seed=1
            )
            .square()
            .sum()
        )

    alone = [torch.autograd.grad(at(x), shift)[0] for x in (0.1, -0.3)]
    both = at(0.1) * 1.0, at(-0.3) * 1.0
    together = torch.autograd.grad(both[0] + both[1], shift)[0]
    assert float(together) == pytest.approx(float(alone[0] + alone[1]), rel=1e-4)


def test_second_derivatives_are_refused():
    shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    wall = Object(Mesh(WALL.vertices + shift, WALL.mesh.faces), RoughDielectric(4.0))
    out = deposit_power(Scene({"wall": wall}), link(), GRID, sampling=COUNTS, seed=1).square().sum()
    (first,) = torch.autograd.grad(out, shift, create_graph=True)
    with pytest.raises(InputError, match="first derivatives of a map"):
        first.sum().backward()


@pytest.mark.parametrize(
    ("scene", "antennas"),
    [
        (occluder(), link(((5.0, 0.0, 0.0),), ((5.0, 0.1, 0.0),), wavelength=WAVELENGTH)),
        (Scene({"ball": thing(sphere(1.0))}), link()),
        (Scene({"plate": thing(slivered(plain()), (1, 0, 0)), "wall": WALL}), link()),
        (Scene({"flat": thing(plate(1.0, 1.0), (1, 0, 0), (0.0, 0.0, np.pi / 2))}), link()),
    ],
    ids=["all behind", "inside a ball", "zero-area triangle", "plate seen edge-on"],
)
def test_odd_scenes_have_maps_that_a_common_shift_leaves(scene, antennas):
    """NaN and infinities would show in the sums, and so would any term that is left out."""
    leaves = {name: item.vertices.clone().requires_grad_() for name, item in scene.objects.items()}
    moved = Scene(
        {
            name: Object(Mesh(leaves[name], item.mesh.faces), item.material)
            for name, item in scene.objects.items()
        }
    )
    tx = antennas.tx.clone().requires_grad_()
    rx = tx if antennas.shared_visibility else antennas.rx.clone().requires_grad_()
    out = deposit_power(moved, replace(antennas, tx=tx, rx=rx), GRID, sampling=COUNTS, seed=1)
    places = [tx] if rx is tx else [tx, rx]
    gradients = torch.autograd.grad(out.sum() * 1e9, [*leaves.values(), *places])
    assert bool((out >= 0).all())
    assert shift_error(gradients) < 1e-4
