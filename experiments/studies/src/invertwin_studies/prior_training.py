"""Training of shape priors on cars of the generator."""

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import torch
from jaxtyping import Float, Float64
from torch import Tensor, nn

from invertwin.checks import checked_count, checked_number
from invertwin.errors import InputError
from invertwin.scene.shape_models.lattice import Lattice
from invertwin.scene.shape_models.prior import Decoder, ShapePrior
from invertwin_studies.vehicles import car_distance, sample_car

_LOW, _HIGH = (-3.4, -1.2, -0.08), (3.2, 1.2, 2.24)  # holds every car of the generator [m]
_NODES = (67, 31, 30)
_NEAR = 0.15  # distances up to here count most [m]
_FAR = 0.02  # weight of those far away
_PACE = (0.1, 1.0, 10.0)  # learning rates of fields, network and latents, over the given one


@dataclass(frozen=True)
class Training:
    """Settings of a training; the defaults are those of the packaged prior.

    Attributes:
        cars: number of cars drawn for it.
        held_out: further cars on which it is judged.
        latent: coordinates of a shape.
        width: of the network's hidden layer.
        features: learned fields.
        epochs: times that every car is seen.
        batch: cars of a step.
        rate: learning rate at the start; it falls to nothing in a half cosine.
        regularizer: weight of ½ |z|² against the mean square error over its first value.
        wheels: whether the cars have wheels.
        seed: of cars, network and order.

    Raises:
        InputError: a count below one, fewer cars than coordinates, a rate that is not positive, or
            a negative weight or seed.
    """

    cars: int = 3000
    held_out: int = 100
    latent: int = 24
    width: int = 128
    features: int = 48
    epochs: int = 40
    batch: int = 50
    rate: float = 2e-3
    regularizer: float = 1e-4
    wheels: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("cars", "held_out", "latent", "width", "features", "epochs", "batch"):
            checked_count(getattr(self, name), name, 1)
        checked_number(self.rate, "rate", 0.0, open_low=True)
        checked_number(self.regularizer, "regularizer", 0.0)
        checked_count(self.seed, "seed", 0, 2**63 - 1)
        if self.cars <= max(self.latent, self.features):
            raise InputError(
                f"expected more cars than {max(self.latent, self.features)} coordinates and "
                f"features, got {self.cars}; give hundreds"
            )


@dataclass(frozen=True)
class Trained:
    """The outcome of :func:`train_prior`.

    Attributes:
        prior: The prior.
        history: A row an epoch: ``epoch``, ``error`` (of the cars of training, as below),
            ``latent`` (root mean square), ``seconds``.
        held_out_error: Root mean square of distances near the surface of cars that were not
            trained on, at their best latents [m].
        mean_error: The same of the mean shape.
        latents: Of the cars of training, in the order of their seeds.
    """

    prior: ShapePrior
    history: list[dict[str, Any]]
    held_out_error: float
    mean_error: float
    latents: Float64[Tensor, "car latent"]


def train_prior(settings: Training | None = None, say: Callable[[str], None] = print) -> Trained:
    """Train a prior on cars of the generator: one latent per car, learned with the decoder.

    Latents and decoder start from the principal components of the distances; both are learned on
    errors weighted by closeness to the surface, with ½ |z|² on the latents; at the end latents are
    given zero mean, unit variance and the order of their effect.

    Source: Park et al. 2019 (DeepSDF), auto-decoder with a Gaussian prior of latents.
    Differs from the source: the decoder gives the values of a grid rather than of a point, so that
    whole fields decode in milliseconds; distances are weighted rather than clamped.

    Args:
        settings: None is that of the packaged prior.
        say: takes a line of the log.

    Returns:
        The prior and how well it does; the same seed gives the same to rounding.
    """
    plan = Training() if settings is None else settings
    lattice = Lattice.from_bounds(_LOW, _HIGH, _NODES)
    say("settings: " + ", ".join(f"{key} {value}" for key, value in asdict(plan).items()))
    begun = time.monotonic()
    cars = car_distances(lattice, plan.cars + plan.held_out, plan.seed, plan.wheels)
    say(f"{len(cars)} cars at {cars.shape[1]} nodes in {time.monotonic() - begun:.0f} s")
    cars, others = cars[: plan.cars], cars[plan.cars :]
    # What is random must not depend on what was drawn before, nor change what is drawn after.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(plan.seed)
        decoder, latents = _first(plan, cars)
    rows = _learn(plan, cars, decoder, latents, say)
    standard = _standardize(decoder, latents)
    found, mean = _held_out(decoder, others)
    say(f"held out: error {found:.5f} m, mean shape {mean:.5f} m")
    return Trained(ShapePrior(decoder, lattice), rows, found, mean, standard)


def car_distances(
    lattice: Lattice, count: int, seed: int, wheels: bool = False
) -> Float[Tensor, "car node"]:
    """Distances of cars, drawn one after another, at the nodes with y ≥ 0 [m], float32.

    Args:
        lattice: The nodes.
        count: Cars to draw.
        seed: Of the cars.
        wheels: Whether they have some.
    """
    half = lattice.nodes[:, lattice.counts[1] // 2 :].float()
    nodes = half.shape[0] * half.shape[1] * half.shape[2]
    distances = torch.empty(count, nodes)
    for k in range(count):
        distances[k] = car_distance(sample_car(seed * 1_000_003 + k), half, wheels).flatten()
    return distances


def _error(decoder: Decoder, latents: Tensor, truth: Tensor) -> Tensor:
    """Mean square error of distances [m²], weighted by closeness to the surface."""
    weight = _FAR + (1 - _FAR) / (1 + (truth / _NEAR) ** 4)
    return (weight * (decoder(latents) - truth).square()).sum() / weight.sum()


def _first(plan: Training, cars: Tensor) -> tuple[Decoder, nn.Parameter]:
    """Decoder and latents of the principal components."""
    mean = cars.mean(0)
    left, singular, right = torch.svd_lowrank(cars - mean, q=max(plan.latent, plan.features) + 8)
    decoder = Decoder(plan.latent, plan.width, plan.features, cars.shape[1])
    size = singular / math.sqrt(plan.cars)
    with torch.no_grad():
        decoder.basis.weight.copy_(right[:, : plan.features] * size[: plan.features])
        decoder.basis.bias.copy_(mean)
        decoder.straight.weight.copy_(torch.eye(plan.features, plan.latent))
        decoder.leave.weight.mul_(0.1)
        decoder.leave.bias.zero_()
    return decoder, nn.Parameter(left[:, : plan.latent] * math.sqrt(plan.cars))


def _learn(
    plan: Training,
    cars: Tensor,
    decoder: Decoder,
    latents: nn.Parameter,
    say: Callable[[str], None],
) -> list[dict[str, Any]]:
    order = torch.Generator().manual_seed(plan.seed)
    fields = [decoder.basis.weight, decoder.basis.bias]
    others = [p for p in decoder.parameters() if all(p is not q for q in fields)]
    optimizer = torch.optim.Adam(
        [
            {"params": fields, "ratio": _PACE[0]},
            {"params": others, "ratio": _PACE[1]},
            {"params": [latents], "ratio": _PACE[2]},
        ],
        lr=plan.rate,
    )
    begun, rows, first = time.monotonic(), [], 0.0
    steps = math.ceil(plan.cars / plan.batch)
    for epoch in range(plan.epochs):
        total = 0.0
        for k, chosen in enumerate(torch.randperm(plan.cars, generator=order).split(plan.batch)):
            done = (epoch + k / steps) / plan.epochs
            for group in optimizer.param_groups:
                group["lr"] = plan.rate * group["ratio"] * 0.5 * (1 + math.cos(math.pi * done))
            truth, z = cars[chosen], latents[chosen]
            error = _error(decoder, z, truth)
            first = first or float(error.detach())
            loss = error / first + plan.regularizer * 0.5 * z.square().sum(1).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            total += float(error.detach()) * len(chosen)
        rows.append(
            {
                "epoch": epoch + 1,
                "error": math.sqrt(total / plan.cars),
                "latent": float(latents.detach().square().mean().sqrt()),
                "seconds": time.monotonic() - begun,
            }
        )
        say(
            "epoch {epoch:3d}: error {error:.5f} m, latent {latent:.3f}, {seconds:.0f} s".format(
                **rows[-1]
            )
        )
    return rows


def _standardize(decoder: Decoder, latents: Tensor) -> Tensor:
    """Latents of zero mean and unit variance in the order of their effect; the decoder follows.

    With z = m + T z′ the decoder's first layers take T and m on.
    """
    decoder.double()
    with torch.no_grad():
        z = latents.detach().double()
        mean = z.mean(0)
        root = torch.linalg.cholesky(torch.cov((z - mean).T))
        white = torch.linalg.solve_triangular(root, (z - mean).T, upper=False).T
        fields = decoder(z)
        slope = torch.linalg.lstsq(white, fields - fields.mean(0)).solution
        turn = torch.linalg.svd(slope, full_matrices=False)[0]
        change = root @ turn
        decoder.enter.bias.add_(decoder.enter.weight @ mean)
        decoder.leave.bias.add_(decoder.straight.weight @ mean)
        for layer in (decoder.enter, decoder.straight):
            layer.weight.copy_(layer.weight @ change)
        return white @ turn


def _held_out(decoder: Decoder, cars: Tensor) -> tuple[float, float]:
    """Errors [m] of cars at their best latents, and at the mean."""
    truth = cars.double()
    latents = torch.zeros(len(cars), decoder.enter.in_features, dtype=torch.float64)
    mean = float(_error(decoder, latents, truth).detach())
    latents.requires_grad_()
    search = torch.optim.LBFGS([latents], max_iter=40, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        search.zero_grad()
        value = _error(decoder, latents, truth) / mean + 1e-4 * latents.square().sum(1).mean()
        value.backward(inputs=[latents])
        return value

    search.step(loss)  # type: ignore[arg-type]
    return math.sqrt(float(_error(decoder, latents, truth).detach())), math.sqrt(mean)
