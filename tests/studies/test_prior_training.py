"""Training of a shape prior on cars of the generator."""

from importlib import resources

import pytest
import torch

from invertwin.errors import InputError
from invertwin.scene import load_prior
from invertwin_studies.prior_training import Training, car_distances, train_prior

SMALL = Training(cars=120, held_out=20, latent=6, width=16, features=8, epochs=6, batch=20)


def quiet(_: str) -> None:
    pass


@pytest.fixture(scope="module")
def trained():
    lines: list[str] = []
    return train_prior(SMALL, lines.append), lines


def test_latents_are_standard_and_stand_for_their_cars(trained):
    found, _ = trained
    latents = found.latents
    assert latents.shape == (120, 6)
    assert float(latents.mean(0).abs().max()) < 1e-6
    assert torch.allclose(torch.cov(latents.T), torch.eye(6, dtype=torch.float64), atol=1e-6)
    lattice = found.prior.lattice
    truth = car_distances(lattice, 5, SMALL.seed)
    decoded = found.prior.decoder(latents[:5])
    mean = found.prior.decoder(torch.zeros(5, 6, dtype=torch.float64))
    near = truth.abs() < 0.1
    gaps = [(field - truth)[near].square().mean().sqrt() for field in (decoded, mean)]
    assert float(gaps[0]) < 0.5 * float(gaps[1])


def test_coordinates_come_in_the_order_of_their_effect(trained):
    found, _ = trained
    effect = [
        float((found.prior.decoder(z) - found.prior.decoder(-z)).norm())
        for z in torch.eye(6, dtype=torch.float64)
    ]
    assert effect[0] > 1.5 * effect[2] > 1.5 * effect[5]


def test_learning_helps_on_cars_that_were_not_seen(trained):
    found, lines = trained
    errors = [row["error"] for row in found.history]
    assert len(errors) == SMALL.epochs
    assert errors[-1] < errors[0]
    assert found.held_out_error < 0.5 * found.mean_error
    assert lines[0].startswith("settings: cars 120, held_out 20, latent 6")
    assert lines[-1].startswith("held out: error")


def test_a_seed_is_a_prior(trained):
    found, _ = trained
    torch.manual_seed(99)
    before = torch.random.get_rng_state()
    again = train_prior(SMALL, quiet)
    assert torch.equal(before, torch.random.get_rng_state())
    for latent, other in zip(found.latents[:3], again.latents[:3], strict=True):
        gap = found.prior.decoder(latent) - again.prior.decoder(other)
        assert float(gap.abs().max()) < 1e-3


def test_the_packaged_log_is_that_of_the_defaults():
    """So that one command without options trains it again."""
    folder = resources.files("invertwin.scene.geometry")
    first = (folder / "vehicle_prior.log").read_text().splitlines()[0]
    lines: list[str] = []

    class StopError(Exception):
        pass

    def say(line: str) -> None:
        lines.append(line)
        raise StopError

    with pytest.raises(StopError):
        train_prior(None, say)
    assert first == lines[0]
    assert load_prior().latent_size == Training().latent


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"cars": 40}, "expected more cars"),
        ({"latent": 0}, "latent"),
        ({"epochs": 0}, "epochs"),
        ({"rate": float("nan")}, r"expected rate in \(0, inf\), got nan"),
        ({"rate": -1.0}, r"expected rate in \(0, inf\), got -1"),
        ({"regularizer": float("nan")}, r"expected regularizer in \[0, inf\), got nan"),
        ({"seed": -1}, r"expected seed as an integer in \[0, 9223372036854775807\], got -1"),
    ],
)
def test_settings_that_cannot_be_trained_are_refused(wrong, said):
    with pytest.raises(InputError, match=said):
        Training(**wrong)
