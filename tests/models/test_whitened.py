"""Whitened maps: the likelihood over a background, with blur and in simulated recordings."""

import pytest
import torch
from torch import Tensor

import invertwin as iw
from invertwin.errors import InputError
from invertwin.inversion import SpectrumLoss
from invertwin.models import ExactMap, SurrogateMap, WhitenedMap
from invertwin.scene import AntennaArray, RoughDielectric, linear_array, plate, rigid
from scenes import float64

CHIRP = iw.FMCW(77e9, 1e9, 50e-6, 64)
RADAR = iw.Radar(
    AntennaArray(torch.zeros(1, 3).double()),
    linear_array(4, CHIRP.wavelength / 2),
    CHIRP,
    torch.zeros(1, 3).double(),
)
GRID = RADAR.grid(range_min=0.5, range_max=3.0, u_max=0.8)
MODEL = SurrogateMap(GRID, iw.Surrogate(range_width=3.0), iw.Sampling(samples=20_000))
SCENE = iw.Scene(
    {
        "plate": iw.Object(
            plate(0.5, 0.5), RoughDielectric(4.0), rigid(translation=float64([2, 0, 0]))
        )
    }
)


def background() -> Tensor:
    """Noise, and clutter in some ranges."""
    power = torch.full((1, *GRID.shape), 2.0, dtype=torch.float64)
    power[:, 5:12] += 30.0
    return power


def test_the_likelihood_is_that_of_the_sum():
    """g a + n B of a whitened map is that of the map itself with B as further power."""
    whitened = WhitenedMap(MODEL.scale_blur(0.0), background())
    predicted = MODEL.scale_blur(0.0).predict(SCENE, RADAR, 0).double()
    generator = torch.Generator().manual_seed(1)
    looks = -torch.rand(predicted.shape, generator=generator, dtype=torch.float64).log()
    gain = 8.0 / float(predicted.max())
    observed = (gain * predicted + background()) * looks
    share = background() / background().mean()
    loss = SpectrumLoss(levels=1, gain="one", floor=1e-9)
    found = loss(gain * whitened.predict(SCENE, RADAR, 0).double(), observed / share)
    ratio = (
        looks * (gain * predicted + background()) / (gain * predicted + background().mean() * share)
    )
    assert float(found) == pytest.approx(float((ratio - ratio.log() - 1).mean()), rel=2e-3)


def test_blur_is_that_of_the_power():
    whitened = WhitenedMap(MODEL, background())
    power = MODEL.scale_blur(0.0).predict(SCENE, RADAR, 0)
    share = background() / background().mean()
    blurred = MODEL.blur_observed(power, RADAR) / MODEL.blur_observed(share, RADAR)
    assert torch.allclose(whitened.blur_observed(power / share, RADAR), blurred, rtol=1e-5)
    assert whitened.has_blur
    assert not whitened.scale_blur(0.0).has_blur
    assert whitened.with_sampling(samples=10).sampling.samples == 10


def test_simulated_recordings_have_noise_of_one_level():
    """Their mean is the whitened prediction and one level, where there is clutter, too."""
    whitened = WhitenedMap(MODEL.scale_blur(0.0), background())
    simulate = whitened.realisations(SCENE, RADAR, 0)
    assert simulate is not None
    mean = whitened.predict(SCENE, RADAR, 0).double()
    noise = float(mean.max()) / 10
    drawn = torch.stack([simulate(seed, noise).double() for seed in range(200)])
    dark = mean < 0.01 * noise
    assert dark.any()
    assert bool(dark[:, 5:12].any())
    parts = [drawn[:, :, rows][:, dark[:, rows]] for rows in (slice(5, 12), slice(12, None))]
    for part in parts:
        assert float(part.mean()) == pytest.approx(noise, rel=0.25)  # calibrated by one draw
        assert float(part.std()) == pytest.approx(float(part.mean()), rel=0.2)
    assert float(parts[0].mean()) == pytest.approx(float(parts[1].mean()), rel=0.12)
    bright = mean > 0.3 * mean.max()
    assert float(drawn[:, bright].mean()) == pytest.approx(
        float(mean[bright].mean() + noise), rel=0.15
    )


def test_fields_have_no_background():
    with pytest.raises(InputError, match="expected a model of mean power"):
        WhitenedMap(ExactMap(GRID), background())
