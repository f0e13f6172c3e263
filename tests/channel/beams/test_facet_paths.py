"""Mirrored chains as exact polygons: against sampled rays, delays, gradients, refusals."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from invertwin.channel import Link, Sampling, trace_facet_paths, trace_field
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.scene import (
    Object,
    PerfectConductor,
    Scene,
    box,
    dihedral,
    plate,
    rigid,
    rotation_from_vector,
    trihedral,
)
from invertwin.scene.mesh import concatenate_meshes
from invertwin.scene.polarisation import Polarisation
from scenes import float64, link, thing

WAVELENGTH = SPEED_OF_LIGHT / 77e9
PLACES = float64([[-2.0, 0.0, 0.0], [-2.0, 0.4, 0.2], [-1.9, -0.4, 0.1]])


def corner(pose: Tensor | None = None) -> Scene:
    """A corner reflector that looks at the antennas, turned a little."""
    turn = rotation_from_vector(float64([0.02, 0.03, -0.05]))
    item = thing(trihedral(0.05), material=PerfectConductor())
    moved = rigid(turn, float64([0.002, 0.004, -0.003])) if pose is None else pose
    return Scene({"corner": item}).replace("corner", pose=moved)


def antennas() -> Link:
    return link(PLACES, wavelength=WAVELENGTH)


def fields(paths, wavelength: float = WAVELENGTH) -> Tensor:
    """H of every frame at the carrier."""
    phase = -2 * math.pi * SPEED_OF_LIGHT / wavelength * paths.delay
    field = paths.coefficient * torch.polar(torch.ones_like(phase), phase)
    return torch.zeros(len(PLACES), dtype=torch.complex128).index_add(0, paths.frame, field)


@pytest.mark.parametrize("turn", [(0.02, 0.03, -0.05), (0.5, -0.1, 0.12)])
def test_polygons_agree_with_sampled_rays(turn):
    """Within 0.2 dB and 0.03 rad at 4 m, half as well at 2 m: beams are those of plane waves."""
    scene = corner(rigid(rotation_from_vector(float64(turn)), float64([0.002, 0.004, -0.003])))
    far = link(2 * PLACES, wavelength=WAVELENGTH)
    sampled = trace_field(
        scene, far, sampling=Sampling(depth=3, conductor_samples=60_000, boundary=False), seed=1
    )
    ratio = fields(trace_facet_paths(scene, far, 3)) / fields(sampled)
    assert (20 * ratio.abs().log10()).abs().max() < 0.2
    assert ratio.angle().abs().max() < 0.03


def test_chains_of_three_bounces_have_the_range_of_the_apex():
    scene = corner()
    apex = scene["corner"].transform[:3, 3]
    paths = trace_facet_paths(scene, antennas(), 3)
    third = paths.select(torch.arange(len(paths)) >= len(paths) - 6 * len(PLACES))
    # The unfolded image of a chain's last point and the apex are on one straight way.
    expected = (PLACES - apex).norm(dim=1)[third.frame]
    assert torch.allclose(third.range, expected, atol=1e-4)
    both = (third.first - PLACES[third.frame]).norm(dim=1) + (
        third.last - PLACES[third.frame]
    ).norm(dim=1)
    assert torch.allclose(both / SPEED_OF_LIGHT, third.delay, rtol=1e-12)


def test_derivatives_are_differences():
    """Of power and phase, with the moving edges of the beams."""

    def values(vector: Tensor) -> Tensor:
        pose = rigid(rotation_from_vector(vector[3:]), vector[:3])
        field = fields(trace_facet_paths(corner(pose), antennas(), 3))
        return torch.cat([field.abs().square(), field.angle()])

    at = float64([0.002, 0.004, -0.003, 0.02, 0.03, -0.05])
    found = torch.autograd.functional.jacobian(values, at)
    steps = torch.eye(6, dtype=torch.float64) * 1e-7
    expected = torch.stack([(values(at + s) - values(at - s)) / 2e-7 for s in steps], 1)
    for mine, theirs in zip(found.split(len(PLACES)), expected.split(len(PLACES)), strict=True):
        assert (mine - theirs).abs().max() < 1e-4 * theirs.abs().max()


def test_turned_about_its_axis_a_corner_looks_the_same_from_its_central_zone():
    """Of the third order alone: the lit area depends on the angle to the axis."""
    powers = []
    for roll in (0.0, 0.3):
        pose = rigid(rotation_from_vector(float64([roll, 0.0, 0.0])))
        paths = trace_facet_paths(corner(pose), antennas(), 3)
        two = trace_facet_paths(corner(pose), antennas(), 2)
        powers.append((fields(paths) - fields(two)).abs())
    assert torch.allclose(*powers, rtol=5e-3)


def test_only_few_flat_conductors_have_chains():
    with pytest.raises(InputError, match="expected smooth conductors alone"):
        trace_facet_paths(Scene({"wall": thing(plate(1, 1))}), antennas(), 1)
    boxes = {
        name: thing(box((0.1, 0.1, 0.1)), (0.0, y, 0.0), material=PerfectConductor())
        for name, y in (("right", -1.0), ("middle", 0.0), ("left", 1.0))
    }
    with pytest.raises(InputError, match="expected at most 24 triangles"):
        trace_facet_paths(Scene(boxes), antennas(), 1)


@pytest.mark.parametrize("pair", ["VV", "HH", "VH"])
def test_chains_are_polarised(pair):
    """A rolled dihedral at 4 m, as sampled rays have it."""
    jones = [Polarisation.from_jones(name, 0.0, 1) for name in pair]
    far = replace(link(2 * PLACES, wavelength=WAVELENGTH), tx_jones=jones[0], rx_jones=jones[1])
    pose = rigid(rotation_from_vector(float64([0.3, 0.0, 0.0])), float64([0.0, 0.0, 0.0]))
    scene = Scene({"a": Object(dihedral(0.05), PerfectConductor(), pose)})
    sampled = trace_field(
        scene, far, sampling=Sampling(depth=2, conductor_samples=60_000, boundary=False), seed=1
    )
    ratio = fields(trace_facet_paths(scene, far, 2)) / fields(sampled)
    assert float((ratio[0] - 1).abs()) < 0.05  # the other places are off its lobe


def test_doubled_facets_are_refused():
    double = concatenate_meshes([plate(0.1, 0.1), plate(0.05, 0.05)])
    scene = Scene({"tile": thing(double, material=PerfectConductor())})
    with pytest.raises(InputError, match="one surface in each place of tile, got 4 triangles"):
        trace_facet_paths(scene, antennas(), 1)


def test_plates_of_two_objects_in_one_plane_are_refused_where_both_would_count():
    tile, patch = thing(plate(0.1, 0.1), material=PerfectConductor()), plate(0.05, 0.04)
    with pytest.raises(InputError, match="got tile and patch in one plane, in a place that is"):
        trace_facet_paths(
            Scene({"tile": tile, "patch": Object(patch, tile.material, tile.transform)}),
            antennas(),
            1,
        )
