"""Diffracted paths of scenes: plates of finite size, what hides them, derivatives by their size."""

import math

import pytest
import torch

from invertwin.channel.em.utd import conductor_coefficients
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.ray_scene import is_visible
from invertwin.channel.rays.topology import topology_of
from invertwin.channel.specular.diffracted_paths import evaluate_diffracted_paths
from invertwin.channel.specular.diffraction_candidates import find_diffraction_candidates
from invertwin.channel.specular.image_method import CandidateSurfaces, FaceInteractions
from invertwin.channel.specular.wedge_scene import WedgeScene
from invertwin.scene import Mesh, box
from scenes import level_plate

K = 2 * math.pi
TX = torch.tensor([1.0, 0.7, -20.0], dtype=torch.float64)


def surroundings(*meshes, scale=1.0):
    """Conductors; a wavelength is a metre."""
    vertices = torch.cat([mesh.vertices for mesh in meshes]) * scale
    topology = topology_of(list(meshes))
    none = FaceInteractions(*torch.zeros(2, len(topology.faces), dtype=torch.bool))
    walls = CandidateSurfaces(vertices.detach(), topology, TX[None], none)
    return WedgeScene(
        vertices, topology, walls, lambda _, cosine: conductor_coefficients(0, cosine)
    )


def sent_by(around, tx, rx, order=1):
    """What edges alone send, by their number from one to order."""
    found = find_diffraction_candidates(around, tx, rx, order, 0, None, 0)
    return [evaluate_diffracted_paths(around, some, tx, rx, K) for some in found]


def behind(around, rx):
    """The field behind a sheet: the straight wave, and what its edges send."""
    tx = TX.expand(len(rx), 3)
    with tracing():
        lit = is_visible(around.surfaces, tx, rx)
        (sent,) = sent_by(around, TX[None], rx)
    length = (rx - tx).norm(dim=1)
    way = (rx - tx) / length[:, None]
    across = torch.eye(3, dtype=torch.complex128) - way[:, :, None] * way[:, None]
    total = torch.polar(lit / length, -K * length)[:, None, None] * across
    turn = torch.polar(torch.ones_like(sent.length), -K * sent.length)
    return total.index_add(0, sent.rx, sent.transfer * turn[:, None, None]), lit


def kirchhoff(side, rx):
    """The straight wave less what would pass through a square: E behind it, E across the way."""
    step = (torch.arange(400, dtype=torch.float64) + 0.5) / 400 * side - side / 2
    x, y = torch.meshgrid(step, step, indexing="ij")
    points = torch.stack([x, y, 0 * x], -1).reshape(-1, 3)
    before, after = (points - TX).norm(dim=1), (points - rx).norm(dim=1)
    leaning = 0.5 * (-TX[2] / before + rx[2] / after)
    wave = torch.polar(leaning / (before * after), -K * (before + after))
    straight = (rx - TX).norm()
    return torch.polar(1 / straight, -K * straight) - 1j * wave.sum() * (side / 400) ** 2


def test_behind_a_plate_and_its_corner_as_by_kirchhoff():
    """From the middle of the shadow across the corner into the light."""
    share = torch.linspace(0.0, 1.0, 7, dtype=torch.float64)[:, None]
    first, last = torch.tensor([[0.2, 0.3, 15.0], [7.0, 6.5, 15.0]], dtype=torch.float64)
    rx = first + share * (last - first)
    found, lit = behind(surroundings(level_plate(6.0, 6.0)), rx)
    assert not lit[0]
    assert lit[-1]
    for field, place in zip(found, rx, strict=True):
        truth = kirchhoff(6.0, place) * 35
        assert abs(field[0, 0] * 35 - truth) < 0.03
        assert abs(field[1, 1] * 35 - truth) < 0.03
    # Without the edges it is nothing, or all.
    assert abs(kirchhoff(6.0, rx[0])) * 35 > 0.2


def test_steps_across_the_corner_are_small():
    steps = torch.linspace(-0.5, 0.5, 101, dtype=torch.float64) + 1e-4
    corner = 3.0 + (3.0 - TX[:2]) * 15 / 20  # where the straight way over it ends
    rx = torch.stack([corner[0] + steps, corner[1] + 0.6 * steps + 0.05, 0 * steps + 15], 1)
    field, lit = behind(surroundings(level_plate(6.0, 6.0)), rx)
    assert 0 < int(lit.sum()) < len(lit)
    step = (field[1:] - field[:-1]).norm(dim=(1, 2)) / field[0].norm()
    assert step.max() < 0.03


def test_edges_in_many_pieces_are_the_same():
    rx = torch.tensor([[0.4, 0.3, 15.0], [4.0, 5.0, 15.0]], dtype=torch.float64)
    whole, _ = behind(surroundings(level_plate(6.0, 6.0)), rx)
    pieces = surroundings(level_plate(6.0, 6.0, divisions=3))
    assert len(pieces.wedges.start) == 4
    torch.testing.assert_close(behind(pieces, rx)[0], whole, rtol=1e-12, atol=1e-14)


def test_derivative_by_the_size_of_a_plate():
    mesh = level_plate(1.0, 1.0)
    x, y = torch.meshgrid(*[torch.linspace(-6.03, 6.1, 5, dtype=torch.float64)] * 2, indexing="ij")
    rx = torch.stack([x, y, 0 * x + 15.0], -1).reshape(-1, 3)

    def power(size):
        return behind(surroundings(mesh, scale=size), rx)[0][:, :, 1].abs().square().sum(1)

    size = torch.tensor(6.0, dtype=torch.float64)
    found = torch.autograd.functional.jacobian(power, size)
    truth = (power(size + 1e-4) - power(size - 1e-4)) / 2e-4
    assert (found - truth).abs().sum() < 1e-6 * truth.abs().sum()
    # Geometric optics alone has no derivative by the size at all.
    assert truth.abs().max() > 0.1 * power(size).max()


def test_what_stands_before_an_edge_hides_it():
    rx = torch.tensor([[0.0, 0.0, 15.0]], dtype=torch.float64)
    screen = level_plate(6.0, 6.0)
    moved = Mesh(
        level_plate(1.0, 12.0).vertices + torch.tensor([2.6, 0.0, 2.0], dtype=torch.float64),
        level_plate(1.0, 12.0).faces,
    )
    with tracing():
        (free,) = sent_by(surroundings(screen), TX[None], rx)
        (hidden,) = sent_by(surroundings(screen, moved), TX[None], rx)
    assert len(free.rx) == 4
    on_side = (hidden.points[:, 0, 0] - 3.0).abs() < 1e-9
    on_screen = hidden.points[:, 0, 2].abs() < 1e-9
    assert not bool((on_side & on_screen).any())
    assert int(on_screen.sum()) == 3


def test_solids_and_order():
    cube = surroundings(box((5.0, 5.0, 5.0)))
    assert len(cube.wedges.start) == 12
    tx = torch.tensor([[9.0, 1.0, 0.5]], dtype=torch.float64)
    rx = torch.tensor([[-9.0, 1.4, 0.2]], dtype=torch.float64)
    with tracing():
        # Face to face no single edge is seen from both sides.
        second, *corners = sent_by(cube, tx, rx, 2)
        assert {part.corner for part in corners} <= {"first", "last"}
        assert second.edge.shape[1] == 2
        assert len(second.rx) >= 4
        inside = torch.zeros(1, 3, dtype=torch.float64)
        assert not sent_by(cube, inside, rx, 3)
    # Over the two edges of a side: front to back.
    over = second.points[:, :, 0]
    straight = (over[:, 0] - 2.5).abs() + (over[:, 1] + 2.5).abs() < 1e-9
    assert int(straight.sum()) == 4
    power = second.transfer[straight].abs().square().sum((1, 2))
    assert bool((power > 0).all())


@pytest.mark.parametrize("order", [1, 2])
def test_an_antenna_on_the_line_of_an_edge_gets_finite_fields(order):
    on_line = torch.tensor([[5.0, 1.0, 0.0]], dtype=torch.float64)
    with tracing():
        found = sent_by(surroundings(level_plate(2.0, 2.0)), on_line, on_line + 1.0, order)
    assert all(torch.isfinite(part.transfer.abs()).all() for part in found)
