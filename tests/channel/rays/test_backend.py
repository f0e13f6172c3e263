"""One thread at a time traces rays, and each keeps its own choice of a backend."""

import multiprocessing
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch.autograd import forward_ad

from invertwin.channel import (
    Sampling,
    backend,
    deposit_power,
    trace_field,
    use_backend,
)
from invertwin.errors import InputError
from invertwin.runtime.concurrency import tracer_lock
from scenes import GRID, link, occluder

FEW = Sampling(depth=1, samples=4000, boundary_samples=500)


def slope(seed):
    """A map of a scene, and the derivative of its sum with respect to a shift."""
    shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    scene = occluder()
    pose = scene["occluder"].transform.clone()
    pose[:3, 3] = pose[:3, 3] + shift
    scene = scene.replace("occluder", pose=pose)
    found = deposit_power(scene, link(), GRID, sampling=FEW, seed=seed)
    found.sum().backward()
    assert shift.grad is not None
    return found.detach(), shift.grad


def test_derivatives_in_threads_are_those_of_one_thread():
    seeds = (1, 2, 3, 4)
    serial = [slope(seed) for seed in seeds]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(slope, seeds))
    for (first, grad), (second, again) in zip(serial, together, strict=True):
        assert torch.allclose(second, first, rtol=1e-6, atol=1e-6 * float(first.max()))
        assert grad.abs().max() > 0
        assert torch.allclose(again, grad, rtol=1e-4, atol=1e-5 * float(grad.abs().max()))


def test_a_graph_of_one_thread_is_differentiated_in_another():
    shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    scene = occluder()
    pose = scene["occluder"].transform.clone()
    pose[:3, 3] = pose[:3, 3] + shift
    total = deposit_power(
        scene.replace("occluder", pose=pose), link(), GRID, sampling=FEW, seed=1
    ).sum()
    with ThreadPoolExecutor(1) as pool:
        pool.submit(total.backward).result()
    assert shift.grad is not None
    expected = slope(1)[1]
    assert torch.allclose(shift.grad, expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max()))


def test_threads_wait_for_rays_and_for_forward_derivatives():
    traced = threading.Event()

    def trace():
        trace_field(
            occluder(), link(), sampling=Sampling(points_per_m2=10.0, boundary=False), seed=1
        )
        traced.set()

    worker = threading.Thread(target=trace)
    with tracer_lock, forward_ad.dual_level():
        worker.start()
        assert not traced.wait(0.5)
        slope(1)  # the thread that holds the lock may trace
    worker.join(60)
    assert traced.is_set()


def test_a_choice_of_backend_is_its_threads_own(monkeypatch):
    monkeypatch.setattr("invertwin.channel.rays.backend._cuda_found", lambda: True)
    with use_backend("cuda"), ThreadPoolExecutor(1) as pool:
        monkeypatch.setenv("INVERTWIN_BACKEND", "cpu")
        assert pool.submit(backend).result() == "cpu"
        assert backend() == "cuda"


def _forked(pipe):
    try:
        slope(1)
        pipe.send("traced")
    except InputError as error:
        pipe.send(str(error))


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_fork_after_the_first_use_is_told_to_spawn():
    slope(1)
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe()
    process = context.Process(target=_forked, args=(there,))
    process.start()
    assert here.poll(60)
    assert "spawn" in here.recv()
    process.join(60)
    assert process.exitcode == 0
