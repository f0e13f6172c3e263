"""Which backend traces rays, and the only place where Mitsuba and Dr.Jit are imported."""

import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch

from invertwin import doctor
from invertwin.errors import InputError

VARIANTS = {"cpu": "llvm_ad_mono_polarized", "cuda": "cuda_ad_mono_polarized"}
_chosen: list[str] = []


@cache
def _cuda_found() -> bool:
    doctor.require()
    import drjit

    return bool(drjit.has_backend(drjit.JitBackend.CUDA))


def backend() -> str:
    """The ray tracer's backend in force: ``cpu`` or ``cuda``.

    The innermost :func:`use_backend` wins, then the environment variable ``INVERTWIN_BACKEND``,
    then ``auto``: CUDA where Dr.Jit finds it, the CPU elsewhere.

    Raises:
        InputError: A name that is not known, or CUDA asked for where there is none.
    """
    if _chosen:
        return _chosen[-1]
    return _resolved(os.environ.get("INVERTWIN_BACKEND", "auto"))


def _resolved(name: str) -> str:
    if name not in ("cpu", "cuda", "auto"):
        raise InputError(
            f"expected backend 'cpu', 'cuda' or 'auto', got {name!r}; "
            "correct the argument or INVERTWIN_BACKEND"
        )
    if name == "auto":
        return "cuda" if _cuda_found() else "cpu"
    if name == "cuda" and not _cuda_found():
        raise InputError("expected an NVIDIA GPU for backend 'cuda', got none; use backend 'cpu'")
    return name


@contextmanager
def use_backend(name: str | None) -> Iterator[None]:
    """Choose ``cpu``, ``cuda`` or ``auto`` inside a ``with`` block; ``None`` changes nothing."""
    _chosen.append(backend() if name is None else _resolved(name))
    try:
        yield
    finally:
        _chosen.pop()


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Keep torch to so many threads inside a ``with`` block.

    Between torch's operations its threads spin for a while, on the cores that trace rays. So torch
    gets one thread for small work, and half of the cores where torch and rays work in turns.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@cache
def _loaded(module: str, name: str) -> Any:
    doctor.require(name)
    return importlib.import_module(module)


class _Mitsuba:
    """Mitsuba, set to the backend in force; imported when it is first used."""

    def __getattr__(self, name: str) -> Any:
        wanted = _chosen[-1] if _chosen else backend()
        module = _loaded("mitsuba", wanted)
        if module.variant() != VARIANTS[wanted]:
            module.set_variant(VARIANTS[wanted])
        return getattr(module, name)


class _DrJit:
    """Dr.Jit, imported when it is first used."""

    def __getattr__(self, name: str) -> Any:
        found = getattr(_loaded("drjit", backend()), name)
        setattr(self, name, found)  # the same for all backends, so that no one asks again
        return found


mi: Any = _Mitsuba()
dr: Any = _DrJit()
