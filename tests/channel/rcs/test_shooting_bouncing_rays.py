"""Tubes in ducts of many facets: their number stays, and so does what they send back."""

import math
from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

import invertwin as iw
from invertwin.channel.beams.beam_tracing import IlluminatedPatches
from invertwin.channel.rcs import far_field as signature
from invertwin.channel.rcs import shooting_bouncing_rays as tubes
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.scene import Mesh, Object, PerfectConductor, Scene
from invertwin.signatures import aspect_directions
from scenes import float64

WAVELENGTH = 0.03
DIRECTIONS = aspect_directions(math.pi / 2, float64([0.2, 0.5])) + float64([0.0, 0.0, 0.1])


def duct(outline: Tensor, length: float, rows: int, bend: float = 0.0) -> Mesh:
    """A sheet along x over an outline in the y-z plane, open at the far end, which is shifted."""
    count, x = len(outline), torch.linspace(0, length, rows + 1, dtype=torch.float64)
    walls = torch.cat([x.repeat_interleave(count)[:, None], outline.repeat(rows + 1, 1)], 1)
    a = torch.arange(rows * count).view(rows, count)
    b = a.roll(-1, 1)
    c, d = a + count, b + count
    back = torch.stack([a[0], b[0], torch.full((count,), len(walls))], 1)
    faces = [torch.stack(corners, 2).reshape(-1, 3) for corners in ((a, c, b), (b, c, d))]
    points = torch.cat([walls, torch.zeros(1, 3).double()])
    points[:, 1] += bend * torch.sin(points[:, 0] / length * math.pi / 2) ** 2
    return Mesh(points, torch.cat([*faces, back]))


def square(pieces: int) -> Tensor:
    """Sides of four wavelengths, in pieces."""
    corner = float64([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * 2 * WAVELENGTH
    share = torch.arange(pieces, dtype=torch.float64)[:, None] / pieces
    return (corner[:, None] + share * (corner.roll(-1, 0) - corner)[:, None]).reshape(-1, 2)


def circle(count: int) -> Tensor:
    """Five wavelengths across."""
    angle = torch.arange(count, dtype=torch.float64) * 2 * math.pi / count
    return 2.5 * WAVELENGTH * torch.stack([angle.cos(), angle.sin()], 1)


def tube_counts(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Number of tubes in each order of what is traced next."""
    counts: list[int] = []
    trace = tubes.trace_tubes

    def counted(*given: object) -> Iterator[IlluminatedPatches]:
        for patches in trace(*given):  # type: ignore[arg-type]
            counts.append(len(patches.aspect))
            yield patches

    monkeypatch.setattr(signature, "trace_tubes", counted)
    return counts


def orders(mesh: Mesh, depth: int = 6, density: float = 8.0) -> Tensor:
    """S of each order, [order, aspect, 2, 2]."""
    scene = Scene({"duct": Object(mesh, PerfectConductor())})
    given = {"depth": depth, "edges": 0, "tubes_per_wavelength": density}
    found = iw.rcs(scene, DIRECTIONS, SPEED_OF_LIGHT / WAVELENGTH, **given)
    return torch.stack([part[0] for part in found.parts.values()])


def decibels(found: Tensor, exact: Tensor) -> float:
    """Largest difference of the co-polar levels of all orders together."""
    totals = [x.sum(0).diagonal(dim1=1, dim2=2).abs() for x in (found, exact)]
    return float((20 * torch.log10(totals[0] / totals[1])).abs().max())


def test_a_duct_of_flat_walls_is_the_same_in_any_triangles(monkeypatch):
    """Against exact beams between twelve triangles."""
    exact = orders(duct(square(1), 8 * WAVELENGTH, 1))
    found = orders(duct(square(20), 8 * WAVELENGTH, 31))
    assert decibels(found, exact) < 0.05
    assert float((found - exact).norm() / exact.norm()) < 0.003
    monkeypatch.setattr(signature, "MAX_FACETS_BEAM_TRACING", 0)
    found = orders(duct(square(1), 8 * WAVELENGTH, 1))
    assert decibels(found, exact) < 0.1


def test_the_number_of_tubes_does_not_grow_with_that_of_triangles(monkeypatch):
    counts = tube_counts(monkeypatch)
    orders(duct(square(20), 8 * WAVELENGTH, 31))
    few = list(counts)
    counts.clear()
    orders(duct(square(40), 8 * WAVELENGTH, 62))
    assert max(counts) < 4.5 * max(few)  # that of lit triangles grows by four
    assert few[-1] < few[0]


@pytest.mark.filterwarnings("ignore:the facets of duct")
def test_narrow_tubes_stay_whole_on_a_round_wall(monkeypatch):
    """Against finer tubes; cuts between all facets make many times more of them."""
    mesh = duct(circle(80), 10 * WAVELENGTH, 40)
    counts = tube_counts(monkeypatch)
    found, whole = orders(mesh, 5), list(counts)
    exact = orders(mesh, 5, density=20.0)
    counts.clear()
    for name in ("_MAX_HEIGHT", "_MAX_UNEVENNESS"):
        monkeypatch.setattr(tubes, name, -1.0)
    orders(mesh, 5)
    assert decibels(found, exact) < 0.15
    assert float((found - exact).norm() / exact.norm()) < 0.01
    assert whole[-1] < counts[-1] / 5


@pytest.mark.filterwarnings("ignore:the facets of duct")
def test_more_tubes_change_little_in_a_bent_duct():
    mesh = duct(0.6 * circle(48), 6 * WAVELENGTH, 24, WAVELENGTH)
    found, more = (orders(mesh, 5, density) for density in (8.0, 16.0))
    assert decibels(found, more) < 0.3
    assert float((found - more).norm() / more.norm()) < 0.03
