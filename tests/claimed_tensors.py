"""Tensors that claim to be on a GPU, for machines that have none.

A `ClaimedTensor` holds its numbers on the CPU and says that it is on `DEVICE`. Within `fake_cuda`,
every operation of torch runs on the numbers, and its result is where a GPU would have it:

- an operation on tensors of both devices raises, as it does with a GPU. Tensors of dimension 0, and
  indices of a tensor on the GPU, may be on the CPU;
- a new tensor is on the CPU unless its ``device`` says otherwise, so that mixing shows;
- what is copied to the CPU, if it is more than one number, is a move (`Moves`) of the function of
  the package that asked for it. Single numbers are what checks and branches read.

torch's FakeTensorMode knows no values, so that it runs no check, branch or mask. A build of torch
without CUDA refuses the name ``cuda`` wherever autograd meets it; `DEVICE` has another one, which
torch registers for backends that are written in Python.
"""

import inspect
import sys
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map
from torch.utils.backend_registration import (
    _DummyBackendModule,
    _DummyPrivateUse1Hook,
    _setup_privateuseone_for_python_backend,
)

import invertwin
import public_names

PACKAGE = Path(invertwin.__file__).parent
CPU, DEVICE = torch.device("cpu"), "claimed"
# Functions that may move more than one number to the CPU, and why.
LISTED = {
    "radar/signal/nufft.py:_transform": "FINUFFT runs on the CPU; with cufinufft nothing moves",
    "radar/signal/range_profile.py:beat_signal": "how many paths each frame has",
    "radar/signal/impairments.py:PhaseNoise.density": "NumPy interpolates a table",
    "radar/processing/detection.py:cell_averaging_cfar": "SciPy's distributions, a few counts",
    "radar/processing/detection.py:ordered_statistics_cfar": "the same",
    "radar/processing/detection.py:peaks": "SciPy's filter of maxima",
    "radar/processing/detection.py:point_cloud": "SciPy's filter of maxima",
    "radar/processing/reflectors.py:detect_points": "points are found one by one",
    "radar/processing/reflectors.py:format_points_csv": "text",
    "radar/processing/vital_signs.py:estimate_vital_signs": "SciPy's filters of one bin",
    "links/listing.py:path_table": "text",
    "inversion/loss.py:SpectrumLoss._differentiate_gain": "gain and noise, found on the CPU",
    "inversion/loss.py:Objective.curvature": "one row per parameter, and these are on the CPU",
    "inversion/confidence/uncertainty.py:_project": "the same",
    "inversion/confidence/uncertainty.py:_frame_covariance": "the same",
}
_KEY = torch._C.DispatchKey  # pyright: ignore[reportAttributeAccessIssue]
aten = torch.ops.aten
_INDEXING = {aten.index.Tensor, aten._unsafe_index.Tensor, aten._index_put_impl_.default}
_INDEXING |= {aten.index_put_.default, aten.index_put.default}
_COPIES = {aten.copy_.default, aten._to_copy.default, aten.lift_fresh.default}
_NUMBERS = {aten._local_scalar_dense.default, aten.equal.default, aten.is_same_size.default}


class ClaimedTensor(Tensor):
    """Numbers on the CPU that claim to be on a GPU."""

    numbers: Tensor

    @staticmethod
    def __new__(cls, numbers: Tensor) -> "ClaimedTensor":
        found = Tensor._make_wrapper_subclass(  # pyright: ignore[reportAttributeAccessIssue]
            cls,
            numbers.shape,
            strides=numbers.stride(),
            storage_offset=numbers.storage_offset(),
            dtype=numbers.dtype,
            layout=numbers.layout,
            device=torch.device(DEVICE, 0),
        )
        found.numbers = numbers
        return found

    def __repr__(self) -> str:  # pyright: ignore[reportIncompatibleMethodOverride]
        return f"ClaimedTensor({self.numbers!r})"

    def tolist(self) -> Any:
        """Move to the CPU; torch's own refuses subclasses."""
        return self.cpu().tolist()

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise AssertionError(f"{func} outside of fake_cuda()")


@dataclass
class Moves:
    """Tensors of more than one number that left the GPU, by the function that moved them."""

    to_cpu: Counter[str] = field(default_factory=Counter)

    def note(self, value: Tensor) -> None:
        """Count a move for the innermost function of the package, or of the tests."""
        if value.numel() <= 1:
            return
        frame = sys._getframe(1)
        while frame is not None:
            file = Path(frame.f_code.co_filename)
            inside = file.is_relative_to(PACKAGE)
            if inside or file.name.startswith("test_"):
                where = file.relative_to(PACKAGE) if inside else file.name
                self.to_cpu[f"{where}:{frame.f_code.co_qualname}"] += 1
                return
            frame = frame.f_back


class _Mode(TorchDispatchMode):
    def __init__(self, moves: Moves) -> None:
        super().__init__()
        self.moves = moves

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        tensors = [v for v in tree_flatten((args, kwargs))[0] if isinstance(v, Tensor)]
        claimed = [value for value in tensors if isinstance(value, ClaimedTensor)]
        is_there = _result_is_claimed(func, args, tensors)
        wanted = torch.device(kwargs.get("device") or CPU).type
        if wanted == "meta":  # shapes alone
            return func(*_bare(args), **_bare(kwargs))
        if kwargs.get("device") is not None:
            is_there, kwargs["device"] = wanted == DEVICE, CPU
        with ExitStack() as stack:
            # Conjugates and zeros are lazy; torch would skip them below a mode.
            for key in (_KEY.Conjugate, _KEY.Negative, _KEY.ZeroTensor):
                guard = torch._C._SetExcludeDispatchKeyGuard  # pyright: ignore
                stack.enter_context(guard(key, False))
            found = func(*_bare(args), **_bare(kwargs))
            if claimed:
                found = tree_map(_resolve, found)
        if not is_there and claimed and func not in _NUMBERS:
            self.moves.note(claimed[0])
        if not is_there:
            return args[0] if func is aten.copy_.default else found
        known = {id(value.numbers): value for value in claimed}

        def wrap(value: Any) -> Any:
            if not isinstance(value, Tensor):
                return value
            # What an operation changed in place stays the tensor that it was.
            return known[id(value)] if id(value) in known else ClaimedTensor(value)

        return tree_map(wrap, found)


def _result_is_claimed(func: Any, args: Any, tensors: list[Tensor]) -> bool:
    """Return whether a result is on the GPU; raise for tensors of both devices."""
    if func in _COPIES:
        return isinstance(args[0], ClaimedTensor)
    if func in _INDEXING and isinstance(args[0], ClaimedTensor):
        tensors = [args[0], *(value for value in args[2:] if isinstance(value, Tensor))]
    arrays = {isinstance(value, ClaimedTensor) for value in tensors if value.ndim}
    numbers = {isinstance(value, ClaimedTensor) for value in tensors if not value.ndim}
    changes_cpu = func._schema.is_mutable and not isinstance(args[0], ClaimedTensor | list)
    if len(arrays) > 1 or (True in numbers and (arrays == {False} or changes_cpu)):
        raise RuntimeError(f"Expected all tensors to be on the same device, got two, in {func}")
    return True in (arrays or numbers)


def _bare(values: Any) -> Any:
    return tree_map(lambda v: v.numbers if isinstance(v, ClaimedTensor) else v, values)


def _resolve(value: Any) -> Any:
    return value.resolve_conj().resolve_neg() if isinstance(value, Tensor) else value


class _NoModule(_DummyBackendModule):
    def is_available(self) -> bool:
        """Return that torch has no accelerator, on which it would store states, for example."""
        return False


class _NoHook(_DummyPrivateUse1Hook):
    def is_available(self) -> bool:
        """Return the same to the part of torch that is written in C++."""
        return False


@cache
def register() -> torch.library.Library:
    """Make `DEVICE` known to torch: before the first derivative of the process."""
    _setup_privateuseone_for_python_backend(DEVICE, _NoModule(), _NoHook())
    library = torch.library.Library("aten", "IMPL")

    # What autograd and `torch.tensor` ask for below the mode.
    def empty(size: Any, stride: Any, dtype: Any = None, **_: Any) -> Tensor:
        return ClaimedTensor(torch.empty_strided(size, stride, dtype=dtype))

    def fill(source: Tensor, target: ClaimedTensor, non_blocking: bool = False) -> Tensor:
        target.numbers.copy_(source)
        return target

    library.impl("empty_strided", empty, "PrivateUse1")
    library.impl("_copy_from", fill, "PrivateUse1")
    return library


@contextmanager
def fake_cuda() -> Iterator[Moves]:
    """Run operations of torch as where there is a GPU; yields what was moved to the CPU."""
    register()
    moves = Moves()
    with _Mode(moves):
        yield moves


def on(device: str | torch.device, values: Any) -> Any:
    """Copy values to a device: tensors, also those in lists, dictionaries and dataclasses.

    Args:
        device: ``cpu``, `DEVICE`, ``cuda``.
        values: what a function is given.
    """
    if isinstance(values, Tensor):
        return values.to(torch.device(device, 0))
    if isinstance(values, tuple | list):
        return type(values)(on(device, value) for value in values)
    if isinstance(values, dict):
        return {name: on(device, value) for name, value in values.items()}
    if is_dataclass(values) and not isinstance(values, type):
        found = object.__new__(type(values))
        for each in fields(values):
            object.__setattr__(found, each.name, on(device, getattr(values, each.name)))
        return found
    return values


def tensors_of(values: Any) -> list[Tensor]:
    """All tensors of a result."""
    if isinstance(values, Tensor):
        return [values]
    if isinstance(values, tuple | list):
        return [found for value in values for found in tensors_of(value)]
    if isinstance(values, dict):
        return [found for value in values.values() for found in tensors_of(value)]
    if is_dataclass(values) and not isinstance(values, type):
        return [
            found for each in fields(values) for found in tensors_of(getattr(values, each.name))
        ]
    return []


Move = Callable[[Any], Any]
Case = Callable[[Move], Any]


def check_case(case: Case, returns_on_cpu: bool = False) -> None:
    """Raise unless a case gives the same numbers on both devices, on its device, without moves.

    Args:
        case: calls a function with what it moves by the function that it is given.
        returns_on_cpu: whether the result is on the CPU wherever its arguments are.
    """
    expected = tensors_of(case(lambda values: values))
    with fake_cuda() as moves:
        found = tensors_of(case(lambda values: on(DEVICE, values)))
        numbers = [value.numbers if isinstance(value, ClaimedTensor) else value for value in found]
    silent = set(moves.to_cpu) - set(LISTED)
    assert not silent, f"moved to the CPU by {sorted(silent)}"
    devices = {isinstance(value, ClaimedTensor) for value in found}
    assert devices <= {not returns_on_cpu}, f"results on both devices, or on the wrong one: {found}"
    assert len(numbers) == len(expected)
    for one, other in zip(numbers, expected, strict=True):
        torch.testing.assert_close(
            one.detach(), other.detach(), rtol=1e-9, atol=1e-12, equal_nan=True
        )


def public_calls(room: str) -> set[str]:
    """Functions of a room's menu, and ``Class.method`` of its classes' own public methods.

    Args:
        room: `invertwin` or a module below it, dotted.
    """
    module, found = import_module(room), set[str]()
    for name in public_names.menu(room):
        value = getattr(module, name)
        if inspect.isclass(value):
            for method, kept in vars(value).items():
                is_method = inspect.isfunction(kept) or isinstance(kept, classmethod | staticmethod)
                if is_method and (not method.startswith("_") or method == "__call__"):
                    found.add(f"{name}.{method}")
        elif callable(value) and inspect.isroutine(value):
            found.add(name)
    return found


def check_on_gpu(case: Case) -> None:
    """Raise unless a case gives the same numbers on the CPU and on the GPU of this machine.

    Args:
        case: as for `check_case`.
    """
    if not torch.cuda.is_available():
        pytest.skip("needs PyTorch with CUDA")
    expected = tensors_of(case(lambda values: values))
    found = tensors_of(case(lambda values: on("cuda", values)))
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        one, other = one.detach().cpu(), other.detach()
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6, equal_nan=True)


class DeviceTests:
    """Tests of a room's functions; a subclass in each room has its cases.

    Attributes:
        room: module of the room, dotted.
        cases: a case for each public function or method.
        no_case: why others have none.
        on_cpu: names of cases whose results are on the CPU wherever their arguments are.
    """

    room: ClassVar[str]
    cases: ClassVar[Mapping[str, Case]]
    no_case: ClassVar[Mapping[str, str]]
    on_cpu: ClassVar[Collection[str]]

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Give each test of a case the names of all."""
        if "name" in metafunc.fixturenames:
            metafunc.parametrize("name", sorted(self.cases))

    def test_is_at_home_on_both_devices(self, name: str) -> None:
        check_case(self.cases[name], returns_on_cpu=name in self.on_cpu)

    @pytest.mark.gpu
    def test_is_the_same_on_a_gpu(self, name: str) -> None:
        check_on_gpu(self.cases[name])

    def test_every_public_function_has_a_case_or_a_reason(self) -> None:
        assert public_calls(self.room) == self.cases.keys() | self.no_case.keys()
        assert not self.cases.keys() & self.no_case.keys()
