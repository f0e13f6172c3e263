"""Fingerprints: equal for equal content in every process, different for every change."""

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from invertwin.channel import Sampling
from invertwin.inversion import SpectrumLoss
from invertwin.inversion.fingerprint import Fingerprint
from invertwin.inversion.regularization import Laplacian
from invertwin.scene import RoughDielectric, Scene, Translation, plate, sphere
from scenes import thing


def same(one: Any, other: Any) -> bool:
    return Fingerprint(one).matches(Fingerprint(other).content())


def weighted(factor: float) -> Callable[..., Any]:
    """A function with a closure."""

    def loss(a: Any, b: Any) -> Any:
        return factor * (a - b).square().mean()

    return loss


class Own:
    """A callable with a state."""

    def __init__(self, scale: float) -> None:
        self.scale = scale
        self.table = torch.arange(5.0) * scale

    def __call__(self, a: Any, b: Any) -> Any:
        return self.scale * (a - b).abs().mean()


@dataclass(frozen=True)
class Value:
    """A value with a part."""

    name: str
    part: Any


BALL = Scene({"ball": thing(sphere(0.2, 1), (0.0, 0.0, 1.0))})
PAIRS: dict[str, tuple[Callable[[], Any], Callable[[], Any]]] = {
    "number": (lambda: 1.0, lambda: 1.0 + 1e-12),
    "kind of number": (lambda: 1, lambda: 1.0),
    "text": (lambda: "mse", lambda: "level"),
    "nothing": (lambda: None, lambda: 0),
    "order": (lambda: [1, 2], lambda: [2, 1]),
    "nesting": (lambda: [[1], [2]], lambda: [[1, 2]]),
    "dataclass": (lambda: SpectrumLoss(), lambda: SpectrumLoss(levels=2)),
    "part": (lambda: Value("a", [1.0]), lambda: Value("a", [2.0])),
    "closure": (lambda: weighted(1.0), lambda: weighted(2.0)),
    "code": (lambda: lambda a, b: (a - b).abs(), lambda: lambda a, b: (a + b).abs()),
    "constant": (lambda: lambda a: a + 1.5, lambda: lambda a: a + 2.5),
    "default": (lambda: lambda a, k=1: a * k, lambda: lambda a, k=2: a * k),
    "partial": (lambda: partial(pow, 2), lambda: partial(pow, 3)),
    "object": (lambda: Own(1.0), lambda: Own(1.5)),
    "method": (lambda: Own(1.0).__call__, lambda: Own(1.5).__call__),
    "weight": (lambda: Laplacian(BALL, "ball", 1.0), lambda: Laplacian(BALL, "ball", 2.0)),
    "material": (
        lambda: BALL,
        lambda: BALL.replace("ball", material=RoughDielectric(4.0, lobe_width=0.4)),
    ),
    "mesh": (lambda: plate(1.0, 1.0), lambda: plate(1.0, 1.001)),
    "faces": (lambda: torch.tensor([0, 1, 2]), lambda: torch.tensor([0, 2, 1])),
    "one datum": (lambda: torch.ones(40, 40), lambda: torch.ones(40, 40).index_fill(1, ROW, 1.01)),
    "moved datum": (lambda: spike(7), lambda: spike(8)),
    "shape": (lambda: torch.ones(2, 3), lambda: torch.ones(3, 2)),
    "parameter": (lambda: Translation("a"), lambda: Translation("a", [0.1, 0.0, 0.0])),
    "held": (lambda: Translation("a"), lambda: Translation("a").requires_grad_(False)),
    "module of an object": (lambda: Translation("a"), lambda: Translation("b")),
    "sampling": (lambda: Sampling(), lambda: Sampling(samples=400_001)),
    "network": (lambda: nn.Linear(2, 2, bias=False), lambda: nn.Linear(2, 2)),
}
ROW = torch.tensor([3])


def spike(place: int) -> torch.Tensor:
    found = torch.zeros(1, 20, 20, dtype=torch.float64)
    found.view(-1)[place] = 1.0
    return found


@pytest.mark.parametrize("name", PAIRS)
def test_a_change_is_seen_and_a_copy_is_not(name):
    one, other = PAIRS[name]
    torch.manual_seed(1)
    first = one()
    torch.manual_seed(1)
    assert same(first, one())
    assert not same(first, other())


FLOOR = 0.01


def helper(a: Any) -> Any:
    return a + FLOOR


def floored(a: Any, b: Any) -> Any:
    return (helper(a) - helper(b)).square().mean()


def test_what_a_function_calls_belongs_to_it(monkeypatch):
    before = Fingerprint(floored).content()
    assert Fingerprint(floored).matches(before)
    module = sys.modules[__name__]
    monkeypatch.setattr(module, "FLOOR", 0.02)
    assert not Fingerprint(floored).matches(before)
    monkeypatch.setattr(module, "FLOOR", 0.01)
    monkeypatch.setattr(module, "helper", lambda a: a - FLOOR)
    assert not Fingerprint(floored).matches(before)


def test_methods_of_a_class_of_ones_own_belong_to_it(monkeypatch):
    before = Fingerprint(Own(1.0)).content()
    assert Fingerprint(Own(1.0)).matches(before)
    monkeypatch.setattr(Own, "__call__", lambda self, a, b: self.scale * (a - b).square().mean())
    assert not Fingerprint(Own(1.0)).matches(before)


def test_rounding_is_no_change():
    """Atomic additions in another order."""
    data = torch.rand(1000, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert same(data, data * (1 + 1e-9))
    assert not same(data, data * (1 + 1e-3))


def test_a_value_within_itself_ends():
    loop: list[Any] = [1]
    loop.append(loop)
    other: list[Any] = [2]
    other.append(other)
    assert not same(loop, other)


def test_content_of_something_else_never_matches():
    assert not Fingerprint(1).matches(None)
    assert not Fingerprint(1).matches({})
    assert not Fingerprint(torch.ones(2)).matches(Fingerprint(1).content())


SCRIPT = """
import sys, torch
from invertwin.inversion import SpectrumLoss
from invertwin.inversion.fingerprint import Fingerprint

class Helper:
    def __init__(self, names):
        self.names = names

def made(power, names):
    helper = Helper(names)
    def loss(a, b):
        inner = [x for x in (a - b).abs() ** power if str(x) not in helper.names]
        return sum(inner) + SpectrumLoss()(a, b)
    return loss

print(Fingerprint(made(2, {"c", "a", "b"}), {"x", "y", "z"}).content()["digest"])
"""


@pytest.mark.slow
def test_a_function_has_the_same_fingerprint_in_a_new_process(repository):
    """No address and no order of a set takes part."""
    found = {
        subprocess.run(
            [sys.executable, "-c", SCRIPT],
            env={"PYTHONPATH": str(Path(repository) / "src"), "PYTHONHASHSEED": seed},
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        for seed in ("1", "2", "3")
    }
    assert len(found) == 1


def test_what_a_name_means_is_that_of_its_value():
    """A frozen value that was replaced and put back is the same again."""
    value = SpectrumLoss()
    assert same(replace(replace(value, levels=2), levels=3), value)
