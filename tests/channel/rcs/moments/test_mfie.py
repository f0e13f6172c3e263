"""Small conductors whose currents are solved: against the Mie series, and where they are not."""

import math
import warnings
from typing import Any

import numpy as np
import pytest
import torch
from scipy.special import spherical_jn, spherical_yn
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel import SphereSection, trace_far_field
from invertwin.channel.rcs.moments import efie_solver as meshed
from invertwin.channel.rcs.moments import mfie as solved
from invertwin.channel.rcs.moments import solver as currents
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import PhysicsWarning
from invertwin.scene import (
    Dielectric,
    Mesh,
    Object,
    PerfectConductor,
    Scene,
    rigid,
    sphere,
)
from scenes import float64

METAL = PerfectConductor()
RADIUS = 0.1
UP = float64([0.0, 0.0, 1.0])
BALL = Scene({"ball": Object(sphere(RADIUS, 4), METAL)})


def parts_of(
    scene: Scene, size: float, sent: object, received: Tensor | None = None, **options
) -> dict[str, Tensor]:
    """Parts of S at k times 0.1 m."""
    given: dict[str, Any] = {"depth": 1, "edges": 1, "tubes_per_wavelength": 4.0, "up": UP}
    frequency = size / RADIUS * SPEED_OF_LIGHT / (2 * math.pi)
    toward = normalize(torch.as_tensor(sent, dtype=torch.float64), dim=1)
    found = trace_far_field(scene, toward, received, float64([frequency]), **(given | options))
    return {name: part[0] for name, part in found.items()}


def field_of(*arguments, **options) -> Tensor:
    return torch.stack([*parts_of(*arguments, **options).values()]).sum(0)


def mie(size: float, angle: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """S over the radius across the plane of scattering and in it, by the angle from forwards.

    Bohren and Huffman, Absorption and Scattering of Light by Small Particles, §4.4, of a perfect
    conductor; their S₁ and S₂ over jk, as our waves turn with exp(+jωt).
    """
    n = np.arange(1, int(size + 4 * size ** (1 / 3) + 12))[:, None]
    j, dj = spherical_jn(n, size), spherical_jn(n, size, derivative=True)
    h = j - 1j * spherical_yn(n, size)
    dh = dj - 1j * spherical_yn(n, size, derivative=True)
    a, b = (j + size * dj) / (h + size * dh), j / h
    mu = np.cos(angle.numpy())
    pi = [np.zeros_like(mu), np.ones_like(mu)]
    for order in range(2, len(n) + 1):
        pi.append(((2 * order - 1) * mu * pi[-1] - order * pi[-2]) / (order - 1))
    low, here = np.stack(pi[:-1]), np.stack(pi[1:])
    tau = n * mu * here - (n + 1) * low
    weight = (2 * n + 1) / (n * (n + 1)) / (1j * size)
    return (weight * (a * here + b * tau)).sum(0), (weight * (a * tau + b * here)).sum(0)


@pytest.mark.parametrize("size", [1.0, 4.4934, 5.0, 7.0, 9.0])
def test_a_ball_is_that_of_mie(size):
    """At 4.4934 the ball's inside is resonant."""
    frequency = float64([size / RADIUS * SPEED_OF_LIGHT / (2 * math.pi)])
    truth = SphereSection(RADIUS).section(frequency, float64([[0.0, 0.0, 1.0]]))[0, 0]
    found = field_of(BALL, size, [[0.3, 0.5, 0.8], [1.0, 0.0, 0.0]])
    error = 10 * torch.log10(4 * math.pi * found.abs().square() / truth)
    assert float(error.diagonal(dim1=1, dim2=2).abs().max()) < 0.1
    assert float(error[:, 0, 1].max()) < -35.0  # nothing turns over


def test_one_surface_alone_fails_at_a_resonance(monkeypatch):
    right = field_of(BALL, 4.4934, [[0.3, 0.5, 0.8]])
    monkeypatch.setattr(solved, "_INNER_WEIGHT", 0j)
    alone = field_of(BALL, 4.4934, [[0.3, 0.5, 0.8]])
    assert float((alone - right).abs().max() / right.abs().max()) > 0.1


def test_every_direction_of_a_ball_is_that_of_mie():
    """Amplitude and phase, of a ball that is somewhere else than the origin."""
    size, place = 5.0, float64([0.3, -0.2, 0.7])
    angle = torch.deg2rad(float64([5.0, 60.0, 90.0, 120.0, 179.0]))
    sent = float64([[1.0, 0.0, 0.0]]).expand(len(angle), 3)
    received = torch.stack([-angle.cos(), angle.sin(), 0 * angle], 1)
    scene = Scene({"ball": Object(sphere(RADIUS, 4), METAL, rigid(translation=place.tolist()))})
    found = field_of(scene, size, sent, received)
    turn = size / RADIUS * ((sent + received) @ place)
    found = found * torch.polar(torch.ones_like(turn), -turn)[:, None, None] / RADIUS
    across, within = (torch.from_numpy(value) for value in mie(size, angle))
    # V is along z here; H turns round with the receiver.
    torch.testing.assert_close(found[:, 0, 0], across, rtol=0.01, atol=0.004)
    torch.testing.assert_close(found[:, 1, 1], -within, rtol=0.01, atol=0.004)
    # Physical optics alone is far off.
    optics = field_of(scene, size, sent, received, edges=0)
    optics = optics * torch.polar(torch.ones_like(turn), -turn)[:, None, None] / RADIUS
    assert float((optics[:, 0, 0] / across).abs().log10().abs().max()) * 20 > 2.0


def test_both_ways_of_solving_agree(monkeypatch):
    directions = [[0.3, 0.5, 0.8], [1.0, 0.1, 0.0]]
    found = []
    for worth in (0, 10**9):
        monkeypatch.setattr(solved, "_CELLS_PER_WAVE_DIRECT", worth)
        found.append(field_of(BALL, 5.0, directions))
    assert float((found[0] - found[1]).abs().max()) < 1e-4 * float(found[0].abs().max())


def test_two_bodies_light_each_other():
    pair = Scene(
        {
            "one": Object(sphere(RADIUS, 3), METAL, rigid(translation=[-0.15, 0.0, 0.0])),
            "two": Object(sphere(RADIUS, 3), METAL, rigid(translation=[0.15, 0.0, 0.0])),
        }
    )
    # Across the line between them, both are alike, and each is nearly as if alone.
    aside = float(field_of(pair, 3.0, [[0.0, 0.0, 1.0]])[0, 0, 0].abs())
    alone = float(field_of(BALL, 3.0, [[0.0, 0.0, 1.0]])[0, 0, 0].abs())
    assert aside == pytest.approx(2 * alone, rel=0.35)
    assert abs(aside / (2 * alone) - 1) > 0.02
    sent, received = (
        normalize(float64([row]), dim=1) for row in ([1.0, 0.2, 0.1], [0.2, -0.4, 1.0])
    )
    there, back = (field_of(pair, 3.0, *way) for way in ((sent, received), (received, sent)))
    torch.testing.assert_close(there, back.mT, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("scene", "size", "options"),
    [
        (BALL, 5.0, {"edges": 0}),
        (BALL, 25.0, {}),
        (Scene({"glass": Object(sphere(RADIUS, 3), Dielectric(4.0))}), 5.0, {}),
        (
            Scene(
                {
                    "one": Object(sphere(RADIUS, 3), METAL),
                    "two": Object(sphere(RADIUS, 3), METAL, rigid(translation=[0.1, 0.0, 0.0])),
                }
            ),
            5.0,
            {},
        ),
    ],
    ids=["optics alone", "large", "dielectric", "overlapping"],
)
@pytest.mark.filterwarnings("ignore::invertwin.errors.PhysicsWarning")
def test_other_targets_are_left_to_rays(scene, size, options):
    found = parts_of(scene, size, [[0.3, 0.5, 0.8]], **options)
    assert "rest" not in found


def test_a_thin_body_has_no_cells():
    """Its cells would have to be as small as it is thick."""
    flat = sphere(RADIUS, 4)
    disc = Mesh(flat.vertices * float64([1.0, 1.0, 0.02]), flat.faces)
    bodies = solved.MFIESolver(disc.vertices[disc.faces], UP)
    refused = bodies.solve_scattering(50.0, [(UP[None], UP[None])])
    assert isinstance(refused, currents.Refusal)
    assert refused.by_size


def test_frequencies_that_are_too_high_have_no_rest():
    frequencies = float64([5.0, 25.0]) / RADIUS * SPEED_OF_LIGHT / (2 * math.pi)
    found = trace_far_field(
        BALL,
        UP[None],
        None,
        frequencies,
        depth=1,
        edges=1,
        tubes_per_wavelength=4.0,
        up=float64([0.0, 1.0, 0.0]),
    )
    assert float(found["rest"][1].abs().max()) == 0.0
    assert float(found["rest"][0].abs().max()) > 0.01 * RADIUS


SMALL = sphere(RADIUS, 2)
TRIANGLES = SMALL.vertices, SMALL.faces, torch.ones(len(SMALL.faces), dtype=torch.bool)
AXIS = float64([[1.0, 0.0, 0.0]])


def test_cells_are_doubled_until_power_is_conserved(monkeypatch):
    errors = iter([0.3, 0.06, 0.01])
    monkeypatch.setattr(solved, "power_error", lambda *_: next(errors))
    solver = solved.MFIESolver(SMALL.vertices[SMALL.faces], UP, range(5))
    found = solver.solve_scattering(30.0, [(AXIS, AXIS)])
    assert not isinstance(found, currents.Refusal)
    assert next(errors, None) is None
    counts = []
    for refinement in range(3):
        cells = solver.elements(30.0, refinement)
        assert not isinstance(cells, currents.Refusal)
        counts.append(len(cells.area))
        equation = solver.assemble_equation(cells, 30.0, 2)
        field = equation.far_field(equation.solve_currents(AXIS), AXIS, AXIS)
        assert torch.equal(field, found[0]) == (refinement == 2)
    assert counts == pytest.approx([250, 500, 1000], rel=0.01)


@pytest.mark.parametrize("most", [12000, 100], ids=["triangles", "finer cells"])
def test_after_refused_cells_triangles_are_solved_and_then_finer_cells(most, monkeypatch):
    errors = iter([0.3, 0.01])
    monkeypatch.setattr(solved, "power_error", lambda *_: next(errors))
    monkeypatch.setattr(meshed, "MAX_UNKNOWNS", most)
    found = field_of(Scene({"ball": Object(SMALL, METAL)}), 3.0, AXIS)
    solver = (
        solved.MFIESolver(SMALL.vertices[SMALL.faces], UP, range(1, 5))
        if most == 100
        else meshed.EFIESolver(*TRIANGLES, UP)
    )
    monkeypatch.setattr(solved, "power_error", lambda *_: 0.01)
    expected = solver.solve_scattering(30.0, [(AXIS, AXIS)])
    assert not isinstance(expected, currents.Refusal)
    torch.testing.assert_close(found, (expected[0] + expected[0].mT) / 2, rtol=1e-6, atol=1e-9)
    # Both are the ball's field, and not that of the first cells.
    first = solved.MFIESolver(SMALL.vertices[SMALL.faces], UP)
    coarse = first.solve_scattering(30.0, [(AXIS, AXIS)])
    assert not isinstance(coarse, currents.Refusal)
    assert 1e-4 < float((coarse[0] - found).abs().max() / found.abs().max()) < 0.1


def test_a_refusal_names_every_reason(monkeypatch):
    monkeypatch.setattr(currents, "_POWER_TOLERANCE", 1e-9)
    monkeypatch.setattr(solved, "MAX_CELLS", 1000)
    monkeypatch.setattr(meshed, "MAX_UNKNOWNS", 1000)
    off = r"power balance off by 0\.\d% on cells"
    text = (
        rf"at 2\.386 GHz currents not solved, because {off}, too many unknowns \(5120 > 1000\), "
        rf"{off}, too many cells \(15\d\d > 1000\): bounces and edges alone are used"
    )
    with pytest.warns(PhysicsWarning, match=text):
        found = parts_of(BALL, 5.0, [[0.3, 0.5, 0.8]])
    assert "rest" not in found


def test_conductors_that_are_merely_too_large_are_left_to_rays_silently():
    with warnings.catch_warnings():
        warnings.simplefilter("error", PhysicsWarning)
        warnings.filterwarnings("ignore", "the facets of ball", PhysicsWarning)
        assert "rest" not in parts_of(BALL, 25.0, [[0.3, 0.5, 0.8]])
