"""Fingerprints of fits: equal in every process, different after any change."""

import hashlib
import inspect
import math
import types
from collections.abc import Mapping, Sequence, Set
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

_PROJECTIONS = 6  # projections of a tensor onto fixed waves: one changed number changes them
_ROUNDING_TOLERANCE = 1e-5  # relative to a tensor's norm: tolerance for another order of additions
_MODULE_ATTRIBUTES = frozenset(vars(nn.Module()))
# Classes of these packages are identified by name; their code belongs to a version, not a fit.
_LIBRARIES = ("builtins", "collections", "functools", "invertwin", "numpy", "torch", "typing")


class Fingerprint:
    """Digest of values by their content.

    Dataclasses, modules and objects count by class and fields, functions by their code and the
    globals and closures that they use, numeric tensors by projections that tolerate rounding.
    User-defined classes count with the code of their methods. No memory address takes part, so that
    a user's function has the same fingerprint in a new process.
    """

    def __init__(self, *values: Any) -> None:
        """Take the fingerprint of these values, in this order."""
        self._hash = hashlib.sha256()
        self._numbers: list[float] = []
        self._open: set[int] = set()
        for value in values:
            self._add(value)

    def content(self) -> dict[str, Any]:
        """Return the fingerprint as plain values for a checkpoint."""
        return {"digest": self._hash.hexdigest(), "numbers": list(self._numbers)}

    def matches(self, stored: Any) -> bool:
        """Return whether stored content belongs to equal values, up to rounding."""
        if not isinstance(stored, dict) or stored.get("digest") != self._hash.hexdigest():
            return False
        return all(
            math.isclose(a, b, rel_tol=_ROUNDING_TOLERANCE, abs_tol=_ROUNDING_TOLERANCE)
            for a, b in zip(stored["numbers"], self._numbers, strict=True)
        )

    def _update_digest(self, *words: object) -> None:
        self._hash.update(("|".join(map(str, words)) + ";").encode())

    def _add(self, value: Any) -> None:
        if value is None or isinstance(value, bool | int | str | bytes):
            self._update_digest(type(value).__name__, value)
        elif isinstance(value, float):
            self._update_digest("float", repr(value))
        elif isinstance(value, Tensor | np.ndarray):
            self._add_tensor(torch.as_tensor(value).detach())
        elif id(value) in self._open:
            self._update_digest("again")
        else:
            self._open.add(id(value))
            self._add_compound(value)
            self._open.discard(id(value))

    def _add_compound(self, value: Any) -> None:
        if isinstance(value, Mapping):
            self._update_digest("mapping", len(value))
            for key, item in value.items():
                self._add(key)
                self._add(item)
        elif isinstance(value, Sequence | Set):
            items = sorted(value, key=repr) if isinstance(value, Set) else value
            self._update_digest("sequence", len(items))
            for item in items:
                self._add(item)
        elif isinstance(value, partial):
            self._update_digest("partial")
            self._add([value.func, list(value.args), dict(value.keywords)])
        elif isinstance(value, types.MethodType):
            self._update_digest("method", value.__func__.__qualname__)
            self._add([value.__func__, value.__self__])
        elif isinstance(value, types.FunctionType):
            self._update_digest("function", value.__module__, value.__qualname__)
            used = inspect.getclosurevars(value)
            around = {n: v for n, v in sorted(used.globals.items()) if not _is_foreign(v, value)}
            enclosed = dict(used.nonlocals)
            self._add([value.__code__, value.__defaults__, value.__kwdefaults__, enclosed, around])
        elif isinstance(value, types.CodeType):
            self._update_digest("code", value.co_code.hex(), *value.co_names)
            self._add(value.co_consts)
        elif isinstance(value, type | types.BuiltinFunctionType | types.ModuleType):
            name = getattr(value, "__qualname__", value)
            self._update_digest(getattr(value, "__module__", ""), name)
        else:
            self._add_object(value)

    def _add_object(self, value: Any) -> None:
        self._update_digest("object", type(value).__module__, type(value).__qualname__)
        if isinstance(value, nn.Module):
            self._add(dict(value.named_parameters(recurse=False)))
            self._add({n: p.requires_grad for n, p in value.named_parameters(recurse=False)})
            self._add(dict(value.named_buffers(recurse=False)))
            self._add(dict(value.named_children()))
        for kind in type(value).__mro__:
            if kind.__module__.split(".")[0] not in _LIBRARIES:
                methods = {n: f for n, f in vars(kind).items() if isinstance(f, types.FunctionType)}
                self._add(methods)
        kept = getattr(value, "__dict__", {})
        slots = [n for c in type(value).__mro__ for n in getattr(c, "__slots__", ())]
        fields = {n: getattr(value, n) for n in slots if hasattr(value, n) and n != "__weakref__"}
        self._add({n: v for n, v in (fields | kept).items() if n not in _MODULE_ATTRIBUTES})

    def _add_tensor(self, value: Tensor) -> None:
        self._update_digest("tensor", value.dtype, tuple(value.shape))
        flat = value.cpu().reshape(-1)
        if not (flat.is_floating_point() or flat.is_complex()):
            self._hash.update(flat.contiguous().numpy().tobytes())
            return
        numbers = torch.view_as_real(flat).reshape(-1) if flat.is_complex() else flat
        numbers = torch.nan_to_num(numbers.double())
        norm = float(numbers.norm())
        index = torch.arange(len(numbers), dtype=torch.float64)
        waves = [
            float((numbers * torch.cos((0.7 + k) * index + k)).sum()) for k in range(_PROJECTIONS)
        ]
        # In units of the norm, so that one tolerance serves all of them.
        self._numbers += [math.log(norm) if norm > 0 else -1e9, *(w / (norm or 1.0) for w in waves)]


def _is_foreign(value: Any, function: types.FunctionType) -> bool:
    """Return whether a global value is defined outside the function's module."""
    if isinstance(value, types.FunctionType):
        return value.__module__ != function.__module__
    return isinstance(value, type | types.ModuleType | types.BuiltinFunctionType)
