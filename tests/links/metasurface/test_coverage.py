"""Coverage with a metasurface: the soft quantile, the aim, and fits in a small room."""

import math
from collections.abc import Sequence

import pytest
import torch

from invertwin.constants import SPEED_OF_LIGHT
from invertwin.inversion import Observation, Optimizer, Stage
from invertwin.inversion.initialisation.multi_start import Candidate, Screening, search
from invertwin.inversion.loss import RatioLoss
from invertwin.links import ElementPhases, Metasurface, PanelPlacement, WallPath
from invertwin.links.metasurface.coverage import Coverage, soft_quantile
from invertwin.models.radio import CoverageMap
from invertwin.scene import Object, PerfectConductor, Scene, plate, rigid, rotation_from_vector
from scenes import float64

FREQUENCY = 60e9
SPACING = SPEED_OF_LIGHT / FREQUENCY / 2
TX = float64([1.0, -2.5, 2.0])


def coverage(count: int) -> Coverage:
    """Receivers behind a screen."""
    turn = rotation_from_vector(float64([0.0, 0.0, -math.pi / 2]))
    pose = rigid(turn, float64([0.5, 0.0, 1.35]))
    scene = Scene({"screen": Object(plate(3.0, 3.0), PerfectConductor(), pose)})
    generator = torch.Generator().manual_seed(2)
    u = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    places = u * float64([2.0, 2.0, 0.0]) + float64([0.0, 0.5, 1.2])
    return Coverage.of(scene, TX, places, FREQUENCY, 0.3)


PLAIN = Metasurface(
    float64([0.0, 0.0, 0.0]),
    torch.eye(3, dtype=torch.float64),
    torch.zeros(8, 8, dtype=torch.float64),
    SPACING,
)


def panel_at(
    along: float, yaw: float = 0.0, spread: Sequence[float] = (0.1, 0.1)
) -> PanelPlacement:
    """8 × 8 elements on the wall x = 3.9, of which a part sees behind the screen."""
    path = WallPath([[3.9, -2.9], [3.9, 2.9]], 1.8)
    return PanelPlacement(
        path,
        TX,
        [1.0, 1.5, 1.2],
        FREQUENCY,
        along=along,
        yaw=yaw,
        spread=spread,
        yaw_limit=0.4,
        spread_limit=0.3,
    )


def test_a_soft_quantile_becomes_the_quantile():
    values = torch.randn(400, generator=torch.Generator().manual_seed(1)).double()
    truth = torch.quantile(values, 0.1)
    assert float(soft_quantile(values, 0.1, 0.0)) == float(truth)
    assert float(soft_quantile(values, 0.1, 0.01)) == pytest.approx(float(truth), abs=0.03)


def test_its_derivatives_are_those_of_differences():
    values = torch.randn(20, generator=torch.Generator().manual_seed(1)).double().requires_grad_()
    (slope,) = torch.autograd.grad(soft_quantile(values, 0.2, 0.3), values)
    assert float(slope.sum()) == pytest.approx(1.0)
    for k in (0, 7):
        step = torch.zeros(20, dtype=torch.float64)
        step[k] = 1e-4
        ends = [soft_quantile(values.detach() + s * step, 0.2, 0.3) for s in (1, -1)]
        assert float(slope[k]) == pytest.approx(float(ends[0] - ends[1]) / 2e-4, rel=1e-5)


def test_strong_receivers_may_be_left_out():
    own = coverage(40)
    with torch.no_grad():
        panel = panel_at(5.0)(PLAIN)
        whole = own.worst(own.gain(panel))
        assert float(own.aim(panel)) == pytest.approx(float(whole))
        assert float(whole) > float(own.worst(own.direct)) + 0.5


def test_the_aim_knows_how_shadows_move():
    own = coverage(40)

    def aim(along: float, *, boundary: bool = True) -> tuple[float, float]:
        module = panel_at(along, spread=(0.2, 0.1))
        level = own.aim(module(PLAIN), 1.0, boundary, 2.0)
        level.backward()
        assert module.along.grad is not None
        return level.item(), module.along.grad.item()

    truth = (aim(0.8 + 1e-6)[0] - aim(0.8 - 1e-6)[0]) / 2e-6
    assert aim(0.8)[1] == pytest.approx(truth, rel=1e-4)
    assert abs(aim(0.8, boundary=False)[1] - truth) > 0.1 * abs(truth)


def level(own: Coverage, module: PanelPlacement) -> float:
    with torch.no_grad():
        return float(own.aim(module(PLAIN)))


def test_a_fit_reaches_the_best_of_the_grid():
    own = coverage(40)
    turns = torch.linspace(-0.4, 0.4, 3).tolist()
    best = max(level(own, panel_at(5.8 * k / 11, yaw)) for k in range(12) for yaw in turns)
    before = -own.worst(own.direct).reshape(1, 1)
    model = CoverageMap(own, 40, blur=0.3)

    def candidate(along: float, yaw: float) -> Candidate:
        unknowns = {"panel": panel_at(along, yaw), "phases": ElementPhases((8, 8))}
        return Candidate(
            own.scene, [Observation(model, before, sensor=PLAIN, parameters=unknowns)], along // 2
        )

    starts = [candidate(0.3 + 0.95 * k, 0.4 * (-1) ** k) for k in range(6)]
    fine = CoverageMap(own, 40, blur=0.03)
    found = search(
        own.scene,
        starts[0].observations,
        [],
        Screening(starts, 2, shortlist=True),
        loss=RatioLoss(),
        optimizer=Optimizer(rate=0.15, rotation_rate=0.06, final_rate=0.003),
        schedule=[Stage(6, unknowns=("panel",)), Stage(15, models=[fine])],
        seed=3,
    )
    assert len(found.losses) == 6
    assert found.best_number == 2  # after two trials
    with torch.no_grad():
        assert float(own.aim(found.best.sensors[0])) > best - 0.2
    shift = dict(found.best.parameters[1].named_parameters())["shift"]
    assert float(shift.detach().abs().max()) > 0.01


def test_a_panel_stays_within_its_ranges():
    module = panel_at(7.0, 1.0, (0.5, -0.5))
    with torch.no_grad():
        module(PLAIN)
    assert float(module.along.detach()) == pytest.approx(5.8)
    assert float(module.yaw.detach()) == 0.4
    assert module.spread.tolist() == [0.3, -0.3]


def test_a_batch_of_receivers_belongs_to_its_seed():
    own = coverage(40)
    model = CoverageMap(own, 10, softness=0.0)
    with torch.no_grad():
        panel = panel_at(5.0)(PLAIN)
        first, again, other = (float(model.predict(own.scene, panel, k)) for k in (1, 1, 2))
    assert first == again != other
