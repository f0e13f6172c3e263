"""Labels and depths of cameras: closed forms, and errors of the stated sizes."""

import pytest
import torch

from invertwin.camera import Camera, photograph
from invertwin.errors import InputError
from invertwin.models.camera import DepthMap
from invertwin.scene import Object, PerfectConductor, Scene, plate, rigid

# Looks along x: −y is on its right, −z down.
AXES = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]).double()
AHEAD = Camera(torch.zeros(3).double(), AXES, 40, 30, 60.0)
FACING = torch.diag(torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64))
# Two squares at 2 m and 3 m; the nearer covers 12 by 12 pixels about the middle of the image.
WORLD = Scene(
    {
        "near": Object(plate(0.4, 0.4), PerfectConductor(), rigid(FACING, [2.0, 0.0, 0.0])),
        "far": Object(plate(1.6, 0.8), PerfectConductor(), rigid(FACING, [3.0, 0.0, 0.0])),
    }
)


def test_labels_and_depths_are_those_of_the_pixels_middles():
    found = photograph(WORLD, AHEAD, seed=0)
    assert int(found.mask("near").sum()) == 12 * 12
    assert int(found.mask("near", "far").sum()) == 32 * 16
    assert found.depth[found.labels == 0] == pytest.approx(2.0, abs=1e-9)
    assert found.depth[found.labels == 1] == pytest.approx(3.0, abs=1e-9)
    assert bool(found.depth[found.labels == -1].isinf().all())


def test_depths_err_by_the_square_of_the_depth():
    found = photograph(WORLD, AHEAD, seed=1, depth_noise=0.01)
    for label, depth in ((0, 2.0), (1, 3.0)):
        errors = found.depth[found.labels == label] - depth
        assert float(errors.std()) == pytest.approx(0.01 * depth**2, rel=0.2)
        assert abs(float(errors.mean())) < 4 * 0.01 * depth**2 / len(errors) ** 0.5


def test_labels_err_at_outlines_alone():
    right = photograph(WORLD, AHEAD, seed=2).labels
    wrong = photograph(WORLD, AHEAD, seed=2, wrong_labels=0.3).labels
    inner = torch.zeros_like(right, dtype=torch.bool)
    inner[:, 11:19, 16:24] = True
    assert bool((right == wrong)[inner].all())
    # A wrong label is one of four neighbours': those of a straight outline differ in one.
    at_outline = 2 * (44 + 92)
    assert 0.04 * at_outline < int((right != wrong).sum()) < 0.12 * at_outline


def test_errors_repeat_with_their_seed():
    first, again, other = (
        photograph(WORLD, AHEAD, seed=seed, wrong_labels=0.5, depth_noise=0.1) for seed in (3, 3, 4)
    )
    assert torch.equal(first.depth, again.depth)
    assert torch.equal(first.labels, again.labels)
    assert not torch.equal(first.labels, other.labels)


def test_infinite_depths_are_the_models_far_ones():
    found = photograph(WORLD, AHEAD, seed=0)
    seen = DepthMap(far=5.0).observe(found.depth)
    assert float(seen.max()) == 5.0
    assert float(seen.min()) == pytest.approx(2.0)


def test_unknown_names_and_shares_are_refused():
    with pytest.raises(InputError, match="among near, far, got 'post'"):
        photograph(WORLD, AHEAD, seed=0).mask("post")
    with pytest.raises(InputError, match="share of wrong labels"):
        photograph(WORLD, AHEAD, seed=0, wrong_labels=2.0)
