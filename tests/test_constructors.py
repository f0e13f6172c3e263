"""Numbers of any size in all public constructors: an `InputError`, or a value, and no other error.

Arguments are made from the annotations of a constructor: one that is plain, and in its place, one
after the other, those that are not finite, negative, zero, or beyond what a float holds.
"""

import importlib
import inspect
import math
import resource
import sys
import types
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest
import torch
from annotated_types import Ge, Gt, Len, MinLen
from torch import Tensor, nn

from invertwin.channel import GainPattern
from invertwin.checks import ArrayLike
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel
from invertwin.limits import AllowedLetters, AllowedValues, UsualValue
from invertwin.models import SurrogateMap
from invertwin.radar import FMCW, Radar
from invertwin.radar.waveform import Waveform
from invertwin.scene import (
    AntennaArray,
    BodyTemplate,
    Isotropic,
    Material,
    Mesh,
    Object,
    Pattern,
    RoughDielectric,
    Scene,
    Translation,
    linear_array,
    person,
    plate,
)

sys.path.insert(0, str(Path(__file__).parents[1] / "docs"))

import public_names

SPACE = 4 << 30  # bytes that constructors may take together
NUMBERS = (
    *(math.nan, math.inf, -math.inf, -1.0, 0.0, -0.0, 1e-320, 1e308, -1e308, 1.5),
    *(0, -1, 2**31, 2**63, -(2**63), 10**400, -(10**400), np.int64(-1), np.float32("nan"), True),
)
FILLS = (math.nan, math.inf, -math.inf, -1.0, 0.0, 1e308, -1e308)
TEXTS = ("", "\0", "\n", "ü" * 300, "a" * 100_000)
#: Those without arguments of which plain ones can be made: modules, functions, bodies, files.
UNSWEPT_MOST = 17
SERVERS = ("Viewer", "InteractiveSensor")  # would listen on a port for each value


#: Of what annotations do not tell, or which has to fit together.
EXAMPLES: dict[Any, Callable[[], Any]] = {
    Mesh: lambda: plate(1.0, 1.0),
    Material: lambda: RoughDielectric(4.0),
    Pattern: Isotropic,
    GainPattern: Isotropic,
    Object: lambda: Object(plate(1.0, 1.0), RoughDielectric(4.0)),
    Scene: lambda: Scene({"x": EXAMPLES[Object]()}),
    AntennaArray: lambda: linear_array(2, 2e-3),
    Waveform: lambda: FMCW(77e9, 1e9, 5e-5, 8),
    Radar: lambda: Radar(
        linear_array(1, 1e-3),
        linear_array(2, 2e-3),
        FMCW(77e9, 1e9, 5e-5, 64),
        torch.zeros(1, 3).double(),
    ),
    ForwardModel: lambda: SurrogateMap(EXAMPLES[Radar]().grid(1.0, 2.0, 0.5)),
    nn.Module: lambda: Translation("x"),
    Path: lambda: Path("x"),
}


class UnknownKindError(Exception):
    """No plain value is known for an annotation."""


def plain(hint: Any) -> Any:
    """A value that an annotation admits."""
    origin, parts = get_origin(hint), get_args(hint)
    if inspect.isclass(hint) and hint in EXAMPLES:
        return EXAMPLES[hint]()
    if origin is Callable or hint is Callable:
        return torch.zeros_like
    if hint is ArrayLike:
        return [0.1, 0.2, 0.3]
    if origin is Annotated:
        return _annotated(parts[0], parts[1:])
    if origin is Literal:
        return parts[0]
    if origin in (Union, types.UnionType):
        return _first(parts)
    if hasattr(hint, "array_type") and hasattr(hint, "dims"):
        return _array(hint)
    if origin is tuple:
        return tuple(plain(part) for part in parts if part is not Ellipsis)
    if origin is not None and issubclass(origin, Mapping):
        return {plain(parts[0]): plain(parts[1])}
    if origin is list or (origin is not None and issubclass(origin, Sequence)):
        return [plain(parts[0])]
    simple = {float: 1.0, int: 2, str: "x", bool: False, type(None): None, Tensor: torch.ones(3)}
    if hint in simple:
        return simple[hint]
    if hint is BodyTemplate:
        return person(spacing=0.05)
    if inspect.isclass(hint) and hint.__module__.startswith("invertwin."):
        try:
            return build(hint, {})
        except InputError:
            pass
    raise UnknownKindError(str(hint))


def _annotated(kind: Any, marks: Sequence[Any]) -> Any:
    for mark in marks:
        if isinstance(mark, UsualValue):
            return mark.value
        if isinstance(mark, AllowedValues):
            return mark.values[0]
        if isinstance(mark, AllowedLetters):
            return mark.letters
        if isinstance(mark, Len | MinLen) and get_origin(kind) is not None:
            item = get_args(kind)[0] if kind != ArrayLike else float
            return [plain(item)] * mark.min_length
    least = max([mark.ge for mark in marks if isinstance(mark, Ge)] + [0])
    least += any(isinstance(mark, Gt) for mark in marks)
    found = plain(kind)
    return found if not isinstance(found, int | float) else type(found)(max(found, least))


def _first(hints: Sequence[Any]) -> Any:
    for hint in sorted(hints, key=lambda hint: hint is type(None)):
        try:
            return plain(hint)
        except (UnknownKindError, InputError):
            pass
    raise UnknownKindError(str(hints))


def _array(hint: Any) -> Any:
    sizes = [size if (size := getattr(dim, "size", None)) is not None else 3 for dim in hint.dims]
    whole = "int" in hint.dtypes[0]
    if len(sizes) >= 2 and sizes[-1] == sizes[-2] and not whole:
        found = torch.eye(sizes[-1]).double().expand(sizes).clone()
    else:
        found = torch.arange(math.prod(sizes)).reshape(sizes) / (1 if whole else 16.0)
    kind = getattr(torch, hint.dtypes[0].replace("^", "").replace("$", ""), torch.float64)
    found = found.to(kind) % 3 if whole else found.to(kind)
    return found if hint.array_type is Tensor else found.numpy()


def hints_of(kind: type) -> dict[str, Any]:
    """Annotations of the arguments of a constructor, by name."""
    signature = inspect.signature(kind)
    own = kind if "__dataclass_fields__" in vars(kind) else kind.__init__
    hints = get_type_hints(own, include_extras=True)
    # What is made by `InitVar`, or by `*arguments`, is left out.
    named = {n: p for n, p in signature.parameters.items() if p.kind not in (2, 4)}
    return {name: hints[name] for name in named if name in hints}


def build(kind: type, given: Mapping[str, Any]) -> Any:
    """An object with some arguments, and plain ones for the others that must be given."""
    hints = hints_of(kind)
    wanted = {
        name: plain(hints[name])
        for name, one in inspect.signature(kind).parameters.items()
        if one.default is inspect.Parameter.empty and name in hints and name not in given
    }
    return kind(**wanted, **given)


def spoiled(value: Any) -> Iterator[Any]:
    """Values of the same kind, hardly any of which are valid."""
    if isinstance(value, str):
        yield from TEXTS
    elif isinstance(value, bool) or value is None:
        return
    elif isinstance(value, int | float):
        yield from NUMBERS
    elif isinstance(value, Tensor | np.ndarray):
        whole = value.dtype in (torch.int64, torch.int32) or value.dtype == np.int32
        for fill in (-1, 0, 2**31 - 1) if whole else FILLS:
            yield value * 0 + fill
    elif isinstance(value, list | tuple) and value and isinstance(value[0], int | float):
        whole = type(value[0]) is int
        for number in (n for n in NUMBERS if type(n) is int or not whole):
            yield type(value)([number, *value[1:]])
        yield type(value)()


@contextmanager
def limited_memory() -> Iterator[None]:
    """An error, and no dead machine, where a constructor takes more than it may."""
    old = resource.getrlimit(resource.RLIMIT_AS)
    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (held + SPACE, old[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, old)


def _classes() -> dict[str, type]:
    found = {}
    for room, names in public_names.documented().items():
        for name in names:
            value = getattr(importlib.import_module(room), name)
            abstract = inspect.isabstract(value) or getattr(value, "_is_protocol", False)
            if inspect.isclass(value) and not abstract and not issubclass(value, BaseException):
                found[name] = value
    return found


CLASSES = _classes()


def swept(kind: type) -> list[tuple[str, Any, BaseException]]:
    """Every argument and value that ended in another error than an `InputError`."""
    failures: list[tuple[str, Any, BaseException]] = []
    for name, hint in hints_of(kind).items():
        for value in spoiled(plain(hint)):
            try:
                build(kind, {name: value})
            except (InputError, UnknownKindError):
                pass
            except BaseException as error:
                failures.append((name, value, error))
    return failures


def shown(value: Any) -> str:
    """A value in short; Python prints no integer of thousands of digits."""
    try:
        return str(value)[:60]
    except ValueError:
        return f"{type(value).__name__} of huge numbers"


def can_be_built(kind: type) -> bool:
    """Whether plain arguments are known, and the constructor takes them or refuses them."""
    try:
        for hint in hints_of(kind).values():
            plain(hint)
        build(kind, {})
    except InputError:
        return True
    except (UnknownKindError, TypeError, ValueError, AttributeError, NameError):
        return False
    return True


@pytest.mark.slow
def test_numbers_of_any_size_are_taken_or_refused(unchecked):
    failures, unswept = [], []
    with warnings.catch_warnings(), limited_memory():
        warnings.simplefilter("ignore")
        for name, kind in CLASSES.items():
            if name in SERVERS:
                continue
            if not can_be_built(kind):
                unswept.append(name)
                continue
            failures += [f"{name}({a}={shown(v)}): {e!r:.200}" for a, v, e in swept(kind)]
    print("\n".join(failures))
    print("unswept:", unswept)
    assert failures == []
    assert len(unswept) <= UNSWEPT_MOST
