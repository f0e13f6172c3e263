"""The forward model: two chains of one shape and one unit, and what it refuses."""

from typing import Any

import pytest
import torch

from invertwin.errors import InputError
from invertwin.radar import Surrogate
from invertwin.scene import PerfectConductor, RoughDielectric, Scene, plate
from invertwin.simulation import simulate, surrogate_correlation
from scenes import float64, occluder, radar, relative, thing


def test_both_chains_have_one_shape_and_one_unit():
    """Averaged over speckle, the exact spectrum is the surrogate's."""
    device = radar([[x, y, 0.0] for x in (-0.3, -0.1, 0.1, 0.3) for y in (-0.1, 0.1)])
    scene = Scene({"plate": thing(plate(0.4, 0.4), (0.0, 0.0, 1.2), (0.0, 0.3, 0.0))})
    grid = device.grid(0.7, 1.7, 0.5)
    smooth = simulate(scene, device, grid, seed=0, surrogate=Surrogate(), samples=200_000)
    assert smooth.paths is None
    assert smooth.beat is None
    looks = []
    for seed in range(60):
        # A flat plate has no paths of several bounces; to look for them takes most of the time.
        exact = simulate(scene, device, grid, seed=seed, density=400.0, depth=1)
        assert exact.spectrum.shape == smooth.spectrum.shape == (8, *grid.shape)
        assert exact.paths is not None
        assert exact.beat is not None
        assert exact.beat.shape == (8, 1, 16, 64)
        looks.append(exact.spectrum)
    mean = torch.stack(looks).mean(0)
    assert float(mean.sum() / smooth.spectrum.sum()) == pytest.approx(1, abs=0.06)
    assert relative(mean.mean(0), smooth.spectrum.mean(0)) < 0.12


def test_conductors_and_dielectrics_in_one_scene():
    device = radar()
    scene = occluder(wall=RoughDielectric(4.0), occluder=PerfectConductor())
    found = simulate(scene, device, device.grid(0.5, 2.5), seed=0, samples=2_000, density=300.0)
    assert found.paths is not None
    assert found.paths.kind == "field"
    assert torch.isfinite(found.spectrum).all()
    assert found.spectrum.any()


def test_noise_of_a_given_level():
    device = radar()
    grid = device.grid(0.5, 2.5)
    clean, noisy, hot = (
        simulate(
            occluder(), device, grid, seed=0, density=200.0, snr_db=snr, noise_figure_db=figure
        ).beat
        for snr, figure in ((None, None), (10.0, None), (None, 12.0))
    )
    assert clean is not None
    assert noisy is not None
    assert hot is not None
    ratio = clean.abs().square().mean() / (noisy - clean).abs().square().mean()
    assert float(10 * ratio.log10()) == pytest.approx(10, abs=0.5)
    assert not torch.equal(hot, clean)


def test_a_seed_repeats():
    device = radar()
    grid = device.grid(0.5, 2.5)
    first, again, other = (
        simulate(occluder(), device, grid, seed=seed, density=200.0, snr_db=10.0).spectrum
        for seed in (3, 3, 4)
    )
    assert torch.allclose(first, again, rtol=1e-6)
    assert relative(other, first) > 0.1


@pytest.mark.parametrize("surrogate", [None, Surrogate()])
def test_motion_is_refused_until_it_is_frozen(surrogate):
    device = radar()
    grid = device.grid(0.5, 2.5)
    moving = occluder().replace("occluder", velocity=float64([0.5, 0.0, 0.0]))
    with pytest.raises(InputError, match="expected objects at rest, got velocities on occluder"):
        simulate(moving, device, grid, seed=0, surrogate=surrogate, samples=1_000, density=50.0)
    frozen = moving.at(0.2).replace("occluder", velocity=None)
    found = simulate(frozen, device, grid, seed=0, surrogate=surrogate, samples=1_000, density=50.0)
    assert found.spectrum.any()


def test_a_view_of_nothing_is_nothing():
    device = radar([[0.0, 0.0, 0.0]])
    away = Scene({"plate": thing(plate(1.0, 1.0), (0.0, 0.0, 2.0), (0.0, torch.pi / 2, 0.0))})
    grid = device.grid(0.5, 2.5)
    for surrogate in (None, Surrogate()):
        found = simulate(away, device, grid, seed=0, surrogate=surrogate, samples=1_000)
        assert float(found.spectrum.max()) < 1e-30


def test_a_mean_spectrum_has_no_noise():
    device = radar()
    with pytest.raises(InputError, match="no noise with a surrogate"):
        simulate(occluder(), device, device.grid(0.5, 2.5), seed=0, surrogate=Surrogate(), snr_db=9)


def test_the_surrogate_correlates_with_the_mean_over_looks():
    """One look is mostly speckle; looks averaged over are the surrogate's map."""
    device = radar()
    grid = device.grid(0.7, 1.7, 0.7)
    scene = Scene({"plate": thing(plate(0.6, 0.4), (0.1, 0.0, 1.2), (0.0, 0.5, 0.0))})

    def found(**options):
        settings = {"samples": 100_000, "density": 600.0, "seed": 0, "depth": 1} | options
        return surrogate_correlation(scene, device, grid, **settings)

    assert found(looks=24) >= 0.9
    assert found(looks=1) < found(looks=24)
    # Another place is another map.
    away = scene.replace("plate", pose=thing(plate(1, 1), (-0.4, 0.0, 1.5)).pose)
    assert surrogate_correlation(away, device, grid, seed=0, density=600.0, depth=1) >= 0.9
    assert found(looks=24, surrogate="gaussian") < found(looks=24)


def test_looks_of_conductors_are_all_the_same():
    device = radar()
    scene = Scene({"plate": thing(plate(0.2, 0.2), (0, 0, 1.2), material=PerfectConductor())})
    settings: dict[str, Any] = {"seed": 0, "samples": 5_000}
    grid = device.grid(0.7, 1.7, 0.7)
    few, many = (
        surrogate_correlation(scene, device, grid, looks=looks, **settings) for looks in (1, 4)
    )
    assert few == pytest.approx(many, rel=1e-5)


@pytest.mark.parametrize("options", [{"looks": 0}, {"surrogate": "exact"}])
def test_a_correlation_needs_looks_and_a_surrogate(options: dict[str, Any]):
    device = radar()
    with pytest.raises(InputError, match="expected looks >= 1 and a surrogate"):
        surrogate_correlation(occluder(), device, device.grid(0.5, 2.5), seed=0, **options)


def test_one_switch():
    device = radar()
    grid = device.grid(0.5, 2.5)
    settings: dict[str, Any] = {"seed": 0, "samples": 2_000, "density": 100.0}
    exact, named, smooth, same = (
        simulate(occluder(), device, grid, surrogate=surrogate, **settings)
        for surrogate in (None, "exact", "response", Surrogate())
    )
    assert exact.beat is not None
    assert torch.allclose(exact.spectrum, named.spectrum, rtol=1e-6)
    assert smooth.beat is None
    assert torch.allclose(smooth.spectrum, same.spectrum, rtol=1e-5)
    with pytest.raises(InputError, match="expected a Surrogate or one of exact"):
        simulate(occluder(), device, grid, surrogate="sharp", **settings)
