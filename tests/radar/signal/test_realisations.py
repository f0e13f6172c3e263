"""Looks: their mean and spread are those of exact spectra, and near frames share speckle."""

import torch

from invertwin.channel import Sampling, trace_field
from invertwin.radar import exact_spectrum
from invertwin.radar.signal.realisations import SpeckleRealisations
from invertwin.scene import Scene, plate
from invertwin.simulation import simulate
from scenes import float64, radar, relative, thing

SAMPLING = Sampling(depth=1, boundary=False, points_per_m2=3_000.0)
SCENE = Scene({"plate": thing(plate(0.5, 0.4), (1.5, 0.1, 0.0), (0.0, 0.0, 0.3))})


def test_looks_have_the_statistics_of_exact_recordings():
    device = radar([[0.0, -0.2, 0.0], [0.0, 0.2, 0.0]], receivers=8)
    grid = device.grid(1.0, 2.0, 0.6)
    looks = SpeckleRealisations(
        trace_field(SCENE, device.link(), sampling=SAMPLING, seed=1), device
    )
    drawn = torch.stack([exact_spectrum(looks.beat(k), device, grid) for k in range(200)])
    exact = torch.stack(
        [simulate(SCENE, device, grid, seed=k, sampling=SAMPLING).spectrum for k in range(60)]
    )
    mean = exact.mean(0)
    # 60 looks leave 13 % of speckle in a bin, and bins are correlated.
    assert relative(drawn.mean(0), mean) < 0.2
    assert abs(float(drawn.mean() / exact.mean()) - 1) < 0.05
    bright = mean > 0.2 * mean.max()
    contrast = [float((maps.std(0) / maps.mean(0))[bright].mean()) for maps in (drawn, exact)]
    assert abs(contrast[0] - contrast[1]) < 0.08
    # Neighbours along range and direction: power of half a cell apart is correlated alike.
    for dim in (2, 3):
        pairs = [
            float(
                (
                    _excess(m).narrow(dim, 1, m.shape[dim] - 1)
                    * _excess(m).narrow(dim, 0, m.shape[dim] - 1)
                )[..., 0].mean()
            )
            for m in (drawn, exact)
        ]
        assert 0.7 < pairs[0] / pairs[1] < 1.3


def _excess(maps: torch.Tensor) -> torch.Tensor:
    return maps - maps.mean(0)


def test_frames_share_speckle_as_far_as_they_are_near():
    """The plate's 0.5 m at 1.5 m let speckle go after λR/(2 · 0.5 m) = 6 mm."""
    device = radar([[0.0, 0.0, 0.0], [0.0, 0.0003, 0.0], [0.0, 0.1, 0.0]], receivers=1)
    grid = device.grid(1.2, 1.8)
    looks = SpeckleRealisations(
        trace_field(SCENE, device.link(), sampling=SAMPLING, seed=1), device
    )
    maps = torch.stack([exact_spectrum(looks.beat(k), device, grid) for k in range(200)])
    bright = maps.mean((0, 1)) > 0.3 * maps.mean((0, 1)).max()
    rows = _excess(maps)[:, :, bright].permute(1, 2, 0).double()
    near, far = (
        float((rows[0] * rows[k]).sum() / (rows[0].norm() * rows[k].norm())) for k in (1, 2)
    )
    assert near > 0.9
    assert abs(far) < 0.2


def test_another_seed_is_another_look():
    device = radar(float64([[0.0, 0.0, 0.0]]), receivers=2)
    looks = SpeckleRealisations(
        trace_field(SCENE, device.link(), sampling=SAMPLING, seed=1), device
    )
    assert torch.equal(looks.beat(3), looks.beat(3))
    assert relative(looks.beat(3).abs(), looks.beat(4).abs()) > 0.3
