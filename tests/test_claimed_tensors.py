"""Tensors that claim to be on a GPU tell functions that mix devices, or move, from clean ones."""

import pytest
import torch
from torch import Tensor

from claimed_tensors import DEVICE, ClaimedTensor, Move, check_case, fake_cuda, on

pytestmark = pytest.mark.fake_cuda
VALUES = torch.linspace(1.0, 2.0, 5, dtype=torch.float64)


def clean(x: Tensor) -> Tensor:
    weight = torch.arange(len(x), dtype=x.dtype, device=x.device)
    some = x[x > 1.2]
    return (x * weight).sum() + some.sum() + float(x.max())


def mixes(x: Tensor) -> Tensor:
    return x * torch.arange(len(x), dtype=x.dtype)


def mixes_in_place(x: Tensor) -> Tensor:
    total = torch.zeros((), dtype=x.dtype)
    total += x.sum()
    return total


def mixes_indices(x: Tensor) -> Tensor:
    return torch.arange(10)[x.long()]


def moves(x: Tensor) -> Tensor:
    return torch.as_tensor(x.cpu().numpy().cumsum()).to(x.device)


def lists(x: Tensor) -> Tensor:
    return torch.tensor(x.tolist(), device=x.device)


def returns_on_the_cpu(x: Tensor) -> Tensor:
    return torch.full((3,), float(x.sum()))


def copies_into_the_cpu(x: Tensor) -> Tensor:
    found = torch.zeros(5, dtype=x.dtype)
    found[:] = x
    return found.to(x.device)


@pytest.mark.parametrize(
    ("function", "complaint"),
    [
        (mixes, "same device"),
        (mixes_in_place, "same device"),
        (mixes_indices, "same device"),
        (moves, "moved to the CPU by .*test_claimed_tensors.py:moves"),
        (lists, "moved to the CPU by .*test_claimed_tensors.py:lists"),
        (copies_into_the_cpu, "moved to the CPU by .*copies_into_the_cpu"),
        (returns_on_the_cpu, "on the wrong one"),
    ],
)
def test_a_planted_fault_is_found(function, complaint):
    with pytest.raises((RuntimeError, AssertionError), match=complaint):
        check_case(lambda move: function(move(VALUES)))


def test_a_clean_function_passes():
    check_case(lambda move: clean(move(VALUES)))


def test_other_numbers_on_the_device_are_found():
    def case(move: Move) -> Tensor:
        x = move(VALUES)
        return x + 1e-6 * isinstance(x, ClaimedTensor)

    with pytest.raises(AssertionError, match="not close"):
        check_case(case)


def test_derivatives_in_both_modes_and_lazy_conjugates_are_right():
    def case(move: Move) -> list[Tensor]:
        x = move(VALUES)
        start = x.clone().requires_grad_()
        (torch.polar(start, start).conj() * start).abs().square().sum().backward()
        assert start.grad is not None
        one = torch.ones((), dtype=x.dtype, device=x.device)
        forward = torch.func.jvp(lambda t: (x + t * x[:1]).norm(), (one,), (one,))
        return [start.grad, *forward, torch.polar(x, x).conj().imag]

    check_case(case)


def test_what_is_made_without_a_device_is_on_the_cpu():
    with fake_cuda() as moves:
        there = on(DEVICE, VALUES)
        assert there.device.type == DEVICE
        assert torch.zeros(3).device.type == "cpu"
        assert there.new_zeros(3).device == there.device
        assert not there.to("cpu").is_meta
        assert sum(moves.to_cpu.values()) == 1
