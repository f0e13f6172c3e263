"""Derivatives that processes share among themselves are those of one process."""

import pytest
import torch
from torch import distributed

from invertwin.channel import Sampling
from invertwin.errors import InputError
from invertwin.inversion import mean_over_views
from invertwin.models.radar import SurrogateMap
from invertwin.runtime.engines import run_jobs
from invertwin.scene import Translation
from invertwin.seeds import derive_seed
from scenes import occluder, radar

VIEWS = range(3)


def of_views() -> tuple[float, list[float]]:
    """Mean loss over views of a scene, and its derivative by the place of an object."""
    device, scene = radar(), occluder()
    model = SurrogateMap(
        device.grid(0.5, 2.5), sampling=Sampling(depth=1, samples=2_000, boundary_samples=500)
    )
    module = Translation(scene.names[0])

    def loss(view: int) -> torch.Tensor:
        return model.predict(module(scene), device, derive_seed(7, view)).sum().log()

    value = mean_over_views(loss, VIEWS, module)
    (parameter,) = module.parameters()
    assert parameter.grad is not None
    return value, parameter.grad.tolist()


def one_of_two(job: tuple[int, str]) -> tuple[float, list[float]]:
    rank, meeting = job
    distributed.init_process_group("gloo", init_method=f"file://{meeting}", rank=rank, world_size=2)
    try:
        return of_views()
    finally:
        distributed.destroy_process_group()


@pytest.mark.slow
def test_two_processes_give_what_one_gives(tmp_path, monkeypatch):
    monkeypatch.setenv("GLOO_SOCKET_IFNAME", "lo")
    jobs = [(rank, str(tmp_path / "meeting")) for rank in (0, 1)]
    first, second = (found for _, found in sorted(run_jobs(one_of_two, jobs, workers=2)))
    assert first == second
    value, slope = of_views()
    assert first[0] == pytest.approx(value, rel=1e-6)
    assert first[1] == pytest.approx(slope, rel=1e-6)
    assert max(map(abs, slope)) > 0.01


def test_the_mean_and_its_derivative_are_added_to_what_is_there():
    module = torch.nn.Linear(2, 1, bias=False).double()
    unused = torch.nn.Module()
    unused.line, unused.other = module, torch.nn.Linear(1, 1)
    rows = torch.tensor([[1.0, 2.0], [3.0, 6.0]], dtype=torch.float64)
    for times in (1, 2):
        value = mean_over_views(lambda k: module(rows[k]).sum(), [0, 1], unused)
        assert value == pytest.approx(module(rows).mean().item())
        assert module.weight.grad is not None
        assert module.weight.grad.tolist() == [[2.0 * times, 4.0 * times]]


@pytest.mark.parametrize("views", [[], [0]])
def test_nothing_to_do_is_told(views):
    module = torch.nn.Linear(1, 1) if not views else torch.nn.ReLU()
    with pytest.raises(InputError, match="expected views and free parameters"):
        mean_over_views(lambda _: torch.zeros(()), views, module)
