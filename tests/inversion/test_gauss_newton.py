"""Gauss–Newton: exact on maps that are quadratic, few steps on real ones, and safe."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor, nn

from fits import fit
from invertwin.channel import Sampling
from invertwin.errors import InputError
from invertwin.inversion import Optimizer, SpectrumLoss
from invertwin.inversion.gauss_newton import GaussNewton
from invertwin.inversion.loss import MapPairs, Objective
from invertwin.radar import surrogate_spectrum
from invertwin.scene.parameters import Pose, Translation
from scenes import float64

SHAPE = (2, 8, 6, 1)


def alone(loss: Any) -> Objective:
    """The objective of one observation."""
    return Objective((loss,), (1.0,))


def random_map(seed: int) -> Tensor:
    return torch.rand(SHAPE, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


class Mixture(nn.Module):
    """A map that is linear in its parameters, one of which is held fixed."""

    def __init__(self, start: list[float]) -> None:
        super().__init__()
        self.share = nn.Parameter(float64(start))
        self.free = float64([1.0, 1.0, 0.0])
        self.base = 2 + random_map(0)
        self.parts = torch.stack([random_map(k) for k in (1, 2, 3)])

    def forward(self) -> Tensor:
        share = self.share * self.free + self.share.detach() * (1 - self.free)
        return self.base + torch.tensordot(share, self.parts, dims=1)


TRUTH = [0.4, -0.3, 0.0]


@pytest.mark.parametrize("kind", ["mse", "likelihood"])
@pytest.mark.parametrize("gain", ["fitted", "one"])
def test_linear_maps_are_solved_in_a_few_steps(kind, gain):
    model, measured = Mixture([0.0, 0.0, 0.0]), Mixture(TRUTH)().detach()
    scale = 3.0 if gain == "fitted" else 1.0
    loss = SpectrumLoss(kind, gain=gain, background="none")
    solver = GaussNewton(model, alone(loss), damping=1e-4)
    losses = [solver.step(lambda: [(model(), scale * measured)]) for _ in range(6)]
    assert torch.allclose(model.share.detach(), float64(TRUTH), atol=1e-4)
    assert losses[-1] < 1e-6 * losses[0]
    assert isinstance(model.share, nn.Parameter)


def test_noise_of_unknown_level_is_fitted_beside_the_parameters():
    """The map is nearly even, so that noise, gain and parameters are hard to tell apart."""
    model, measured = Mixture([0.0, 0.0, 0.0]), Mixture(TRUTH)().detach()
    solver = GaussNewton(model, alone(SpectrumLoss(gain="one")), damping=1e-4)
    losses = [solver.step(lambda: [(model(), measured + 1.5)]) for _ in range(12)]
    assert torch.allclose(model.share.detach(), float64(TRUTH), atol=2e-3)
    assert losses[-1] < 1e-5 * losses[0]


@pytest.mark.parametrize("kind", ["mse", "likelihood"])
@pytest.mark.parametrize("background", ["none", "level", "static"])
def test_curvature_is_the_second_derivative_at_the_truth(kind, background):
    """Where simulation and data agree, Gauss–Newton leaves nothing out."""
    if kind == "likelihood" and background == "static":
        return
    model = Mixture(TRUTH)
    measured, map_ = model().detach(), model().detach()
    loss = SpectrumLoss(kind, gain="one", background=background)
    found = loss.curvature(map_, measured, model.parts)

    def value(share: Tensor) -> Tensor:
        return loss(model.base + torch.tensordot(share, model.parts, dims=1), measured)

    truth = torch.func.hessian(value)(model.share.detach())
    assert torch.allclose(found, truth, rtol=1e-5, atol=1e-9)


def test_reaches_of_parameters_are_their_own():
    model, measured = Mixture([0.0, 0.0, 0.0]), Mixture(TRUTH)().detach()
    solver = GaussNewton(model, alone(SpectrumLoss(gain="one")), trust_radii={model.share: 0.1})
    solver.step(lambda: [(model(), measured)])
    assert float(model.share.detach().abs().max()) == pytest.approx(0.1)
    rates, first = Optimizer("gauss_newton", rate=0.3), Translation("a")
    built = rates.build(
        nn.ModuleList([first, Pose("b")]), alone(SpectrumLoss()), {first.translation: 0.2}
    )
    assert isinstance(built, GaussNewton)
    assert built.reach.tolist() == [0.2] * 3 + [0.3] * (len(built.reach) - 3)


def test_what_a_gain_explains_tells_nothing():
    measured = random_map(4) + 1
    tangents = torch.stack([measured, random_map(5)])
    for kind in ("mse", "likelihood"):
        found = SpectrumLoss(kind).curvature(measured, measured, tangents)
        assert abs(float(found[0, 0])) < 1e-6
        assert float(found[1, 1]) > 1e-4


def test_a_fixed_coordinate_stays_to_the_last_bit():
    model = Mixture([0.1, 0.2, 0.123456789])
    measured = Mixture(TRUTH)().detach()
    loss = SpectrumLoss(background="none")
    GaussNewton(model, alone(loss)).step(lambda: [(model(), measured)])
    assert float(model.share[2].detach()) == 0.123456789
    assert float(model.share[0].detach()) != 0.1


def test_no_step_is_longer_than_its_reach_and_none_makes_it_worse():
    measured = Mixture(TRUTH)().detach()
    model = Mixture([0.0, 0.0, 0.0])
    GaussNewton(model, alone(SpectrumLoss()), trust_radius=0.01).step(lambda: [(model(), measured)])
    assert float(model.share.detach().abs().max()) == pytest.approx(0.01, rel=1e-6)

    class Wrong(Mixture):
        """Its derivative points the wrong way."""

        def forward(self) -> Tensor:
            return self.base + torch.tensordot(2 * self.share.detach() - self.share, self.parts, 1)

    wrong = Wrong([0.0, 0.0, 0.0])
    solver = GaussNewton(wrong, alone(SpectrumLoss(gain="one")))
    solver.step(lambda: [(wrong(), measured)])
    assert torch.equal(wrong.share.detach(), torch.zeros(3, dtype=torch.float64))
    assert solver.damping > 0.01
    again = GaussNewton(wrong, alone(SpectrumLoss()))
    again.load_state_dict(solver.state_dict())
    assert again.damping == solver.damping


def test_a_curvature_serves_several_steps():
    """With a kept one a step still goes down, and its derivatives are asked for less often."""
    measured = Mixture(TRUTH)().detach()

    def asked(every: int) -> tuple[int, Tensor]:
        model, count = Mixture([0.0, 0.0, 0.0]), 0
        solver = GaussNewton(
            model,
            alone(SpectrumLoss(gain="one", background="none")),
            damping=1e-4,
            curvature_every=every,
        )

        def maps() -> MapPairs:
            nonlocal count
            count += forward_ad.unpack_dual(model.share).tangent is not None
            return [(model(), measured)]

        for _ in range(6):
            solver.step(maps)
        return count, model.share.detach()

    each, found = asked(1)
    third, also = asked(3)
    assert (each, third) == (12, 4)
    for share in (found, also):
        assert torch.allclose(share, float64(TRUTH), atol=1e-4)


def test_a_kept_curvature_goes_on_from_a_checkpoint():
    measured = Mixture(TRUTH)().detach()

    def steps(count: int, state: Any = None) -> tuple[Tensor, dict[str, Any]]:
        model = Mixture([0.0, 0.0, 0.0])
        solver = GaussNewton(model, alone(SpectrumLoss()), trust_radius=0.1, curvature_every=4)
        if state is not None:
            solver.load_state_dict(state[1])
            model.share.data.copy_(state[0])
        for _ in range(count):
            solver.step(lambda: [(model(), measured)])
        return model.share.detach().clone(), solver.state_dict()

    assert torch.equal(steps(6)[0], steps(3, steps(3))[0])


def test_a_penalty_takes_part_with_its_own_curvature():
    model = Mixture([0.0, 0.0, 0.0])
    measured = Mixture([0.0, 0.0, 0.0])().detach()
    wish = float64([0.2, 0.1, 0.0])
    heavy = GaussNewton(model, alone(SpectrumLoss(gain="one")), damping=1e-4)
    for _ in range(3):
        heavy.step(
            lambda: [(model(), measured)],
            lambda: 1e4 * (model.share * model.free - wish).square().sum(),
        )
    assert torch.allclose(model.share.detach(), wish, atol=1e-4)


def test_a_displaced_plate_is_found_in_eight_steps(case):
    """The same plate takes Adam 60 steps (test_reconstruction). The array tells nothing of z."""
    module = Translation("plate", axes="xy")
    surrogate = case.settings()["surrogate"]
    # With fewer bins a cell the surrogate is no mean, and where the fit ends is up to its seeds.
    grid = case.radar.grid(1.0, 2.4, 0.5, oversample=2)
    solver = GaussNewton(module, alone(SpectrumLoss()), trust_radius=0.1)
    for step in range(8):
        left = max(0.0, 1 - step / 5)
        kernels = replace(surrogate, range_width=2 * left, angle_width=left)

        def maps(step: int = step, kernels: Any = kernels) -> MapPairs:
            simulated = surrogate_spectrum(
                module(case.scene),
                case.radar,
                grid,
                kernels,
                sampling=Sampling(depth=1, samples=40_000, boundary_samples=10_000),
                seed=step,
            )
            measured = case.capture.spectrum(grid).float()
            return [(simulated, kernels.blur(measured, case.radar, grid))]

        solver.step(maps)
    error = case.error(module(case.scene))
    assert float(error[:2].norm()) < 0.02


def test_bad_input(unchecked):
    model, many = Mixture([0.0, 0.0, 0.0]), Translation("plate")
    many.translation = nn.Parameter(torch.zeros(65, dtype=torch.float64))
    with pytest.raises(InputError, match="expected a SpectrumLoss for Gauss–Newton, got function"):
        GaussNewton(model, alone(lambda a, b: a))  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"trust_radius in \(0"):
        GaussNewton(model, alone(SpectrumLoss()), trust_radius=0.0)
    with pytest.raises(InputError, match="got 0,"):
        GaussNewton(nn.ReLU(), alone(SpectrumLoss()))
    solver = GaussNewton(many, alone(SpectrumLoss()))
    with pytest.raises(InputError, match="expected at most 64 parameters"):
        solver.step(lambda: [(many.translation.exp().sum() * random_map(0), random_map(1))])


def test_a_map_that_is_not_finite_is_reported_not_followed():
    model = Mixture([0.1, 0.0, 0.0])
    measured = Mixture(TRUTH)().detach()
    found = GaussNewton(model, alone(SpectrumLoss())).step(lambda: [(model() * math.nan, measured)])
    assert math.isnan(found)
    assert float(model.share[0].detach()) == 0.1


def test_a_turned_pose_has_free_quaternion_numbers_only(case):
    module = Pose("plate", axes="x", rotation_axes="z")
    measured = case.capture.spectrum(case.grid).float()

    def maps() -> MapPairs:
        simulated = surrogate_spectrum(
            module(case.scene),
            case.radar,
            case.grid,
            case.settings()["surrogate"],
            sampling=Sampling(depth=1, samples=4_000, boundary_samples=1_000),
            seed=0,
        )
        return [(simulated, measured)]

    names = [name for name, _ in module.named_parameters()]
    GaussNewton(module, alone(SpectrumLoss("likelihood"))).step(maps)
    assert [name for name, _ in module.named_parameters()] == names
    state = module.state_dict()
    assert torch.equal(state["translation"][1:], torch.zeros(2, dtype=torch.float64))
    assert torch.equal(state["rotation"][[1, 2]], torch.zeros(2, dtype=torch.float64))
    assert float(state["translation"][0].abs()) > 0


class InterruptError(Exception):
    """Stands for whatever ends a run."""


@pytest.mark.slow
def test_reconstruct_takes_its_steps_and_resumes(case, tmp_path):
    def fitted(**changes: Any) -> Any:
        settings = case.settings(steps=4, optimizer=Optimizer("gauss_newton", rate=0.1))
        module = Translation("plate", axes="xy")
        return fit(case.scene, case.radar, case.capture, module, **(settings | changes))

    whole = fitted()
    assert float(case.error(whole.scene)[:2].norm()) < 0.05
    assert [row["step"] for row in whole.history] == [0, 1, 2, 3]

    def stop(row: dict[str, Any]) -> None:
        if row["step"] == 2:
            raise InterruptError

    kept = {"checkpoint": tmp_path / "fit.pt", "checkpoint_every": 1}
    with pytest.raises(InterruptError):
        fitted(progress=stop, **kept)
    resumed = fitted(resume=True, **kept)
    first, second = (
        torch.tensor(found.history[-1]["values"]["plate.translation"]) for found in (whole, resumed)
    )
    assert torch.allclose(first, second, atol=2e-3)
    fitted(optimizer=Optimizer(), **kept)
    with pytest.raises(InputError, match="one of another"):
        fitted(resume=True, **kept)
    with pytest.raises(
        InputError,
        match=r"smooth models .* 'gauss_newton', got ExactMap",
    ):
        fitted(surrogate="exact")
