"""Exact signals: their mean is the surrogate's, their noise, and what is refused."""

from dataclasses import replace

import pytest
import torch

from invertwin.channel import Sampling
from invertwin.errors import InputError
from invertwin.models.radar import ExactMap, SurrogateMap
from invertwin.radar import Impairments
from invertwin.scene import (
    AntennaArray,
    PerfectConductor,
    RoughDielectric,
    Scene,
    dihedral,
    plate,
)
from invertwin.simulation import simulate
from scenes import float64, occluder, radar, relative, thing

FEW = Sampling(points_per_m2=200.0)


@pytest.mark.slow
def test_exact_signals_and_surrogate_have_one_shape_and_one_unit():
    """Averaged over speckle, the exact spectrum is the surrogate's."""
    device = radar([[0.0, y, z] for y in (-0.3, -0.1, 0.1, 0.3) for z in (-0.1, 0.1)])
    scene = Scene({"plate": thing(plate(0.4, 0.4), (1.2, 0.0, 0.0), (0.0, 0.0, 0.3))})
    grid = device.grid(0.7, 1.7, 0.5)
    smooth = SurrogateMap(grid, sampling=Sampling(samples=200_000)).predict(scene, device, 0)
    looks = []
    for seed in range(60):
        # A flat plate has no paths of several bounces; to look for them takes most of the time.
        drawn = Sampling(depth=1, points_per_m2=400.0)
        exact = simulate(scene, device, grid, seed=seed, sampling=drawn)
        assert exact.spectrum.shape == smooth.shape == (8, *grid.shape)
        assert exact.beat.shape == (8, 1, 16, 64)
        looks.append(exact.spectrum)
    mean = torch.stack(looks).mean(0)
    assert float(mean.sum() / smooth.sum()) == pytest.approx(1, abs=0.06)
    assert relative(mean.mean(0), smooth.mean(0)) < 0.12


def test_conductors_and_dielectrics_in_one_scene():
    device = radar()
    scene = occluder(wall=RoughDielectric(4.0), occluder=PerfectConductor())
    drawn = Sampling(conductor_samples=2_000, points_per_m2=300.0)
    found = simulate(scene, device, device.grid(0.5, 2.5), seed=0, sampling=drawn)
    assert found.paths.kind == "field"
    assert torch.isfinite(found.spectrum).all()
    assert found.spectrum.any()


def test_noise_of_a_given_level():
    device = radar()
    grid = device.grid(0.5, 2.5)
    clean, noisy, hot = (
        simulate(
            occluder(), device, grid, seed=0, sampling=FEW, snr_db=snr, noise_figure_db=figure
        ).beat
        for snr, figure in ((None, None), (10.0, None), (None, 12.0))
    )
    ratio = clean.abs().square().mean() / (noisy - clean).abs().square().mean()
    assert float(10 * ratio.log10()) == pytest.approx(10, abs=0.5)
    assert not torch.equal(hot, clean)


def test_a_seed_repeats():
    device = radar()
    grid = device.grid(0.5, 2.5)
    first, again, other = (
        simulate(occluder(), device, grid, seed=seed, sampling=FEW, snr_db=10.0).spectrum
        for seed in (3, 3, 4)
    )
    assert torch.allclose(first, again, rtol=1e-6)
    assert relative(other, first) > 0.1


def test_motion_is_refused_until_it_is_frozen():
    device = radar()
    grid, few = device.grid(0.5, 2.5), Sampling(samples=1_000, points_per_m2=50.0)
    moving = occluder().replace("occluder", velocity=float64([0.0, 0.5, 0.0]))
    with pytest.raises(InputError, match="expected objects at rest, got velocities on occluder"):
        simulate(moving, device, grid, seed=0, sampling=few)
    frozen = moving.advance(0.2).replace("occluder", velocity=None)
    assert simulate(frozen, device, grid, seed=0, sampling=few).spectrum.any()
    assert SurrogateMap(grid, sampling=few).predict(frozen, device, 0).any()


def test_a_view_of_nothing_is_nothing():
    device = radar([[0.0, 0.0, 0.0]])
    away = Scene({"plate": thing(plate(1.0, 1.0), (2.0, 0.0, 0.0), (0.0, 0.0, torch.pi / 2))})
    grid = device.grid(0.5, 2.5)
    for model in (ExactMap(grid, Sampling(samples=1_000)), SurrogateMap(grid)):
        assert float(model.predict(away, device, 0).max()) < 1e-30


def test_two_noise_levels_are_refused():
    device = radar()
    with pytest.raises(InputError, match="expected the noise level in the impairments"):
        simulate(
            occluder(), device, device.grid(0.5, 2.5), seed=0, snr_db=9, impairments=Impairments()
        )


@pytest.mark.usefixtures("unchecked")
def test_wrong_types_are_told_in_one_line():
    import invertwin as iw

    with pytest.raises(iw.InputError, match=r"expected a scene \(Scene\), got None; build one"):
        iw.simulate(None, radar="x", grid=None, seed=1)  # type: ignore[arg-type]


def test_a_radar_of_both_polarisations_hears_each_as_one_of_its_own():
    """Channels of elements that differ are those of radars whose elements are alike."""
    scene = Scene(
        {
            "metal": thing(dihedral(0.1), (1.5, 0, 0), (0.4, 0, 0), material=PerfectConductor()),
            "rough": thing(plate(0.1, 0.1), (1.5, 0.2, 0), material=RoughDielectric(4.0)),
        }
    )
    spots = float64([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    device = replace(radar(), receivers=AntennaArray(spots, polarisation=[[1.0, 0.0], [0.0, 1.0]]))
    few = Sampling(
        depth=2, conductor_samples=2_000, points_per_m2=1000.0, rough_paths=1000, boundary=False
    )
    both = simulate(scene, device, device.grid(0.5, 2.5), seed=0, sampling=few).beat
    for number, polarisation in enumerate("VH"):
        one = replace(device, receivers=AntennaArray(spots[:1], polarisation=polarisation))
        alone = simulate(scene, one, one.grid(0.5, 2.5), seed=0, sampling=few).beat
        assert torch.allclose(both[:, :, number], alone[:, :, 0], rtol=1e-6, atol=1e-14)
        assert alone.any()
