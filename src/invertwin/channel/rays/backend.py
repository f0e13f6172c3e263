"""Backend of the ray tracer; the only file that imports Mitsuba and Dr.Jit.

The ray tracer and torch's forward-mode derivatives have one state for the whole process, so that
one thread at a time may use them; other threads wait.
"""

import importlib
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any, TypeAlias

import torch

from invertwin.errors import InputError
from invertwin.runtime import doctor, threads
from invertwin.runtime.concurrency import tracer_lock

if TYPE_CHECKING:
    import mitsuba as mit  # type: ignore[reportUnusedImport]
else:

    class _Untyped:
        """Types that are not checked at run time: those of Mitsuba depend on the backend."""

        def __getattr__(self, name: str) -> Any:
            return Any

    mit = _Untyped()

Mask: TypeAlias = mit.Bool | bool
"""Active lanes: one value for each, or one for all."""
VARIANTS = {"cpu": "llvm_ad_mono_polarized", "cuda": "cuda_ad_mono_polarized"}


class _ThreadState(threading.local):
    def __init__(self) -> None:
        self.backends: list[str] = []  # backends, the innermost one last
        self.is_tracing = False


_thread = _ThreadState()
_forked = False  # True if the parent of this process had started the ray tracer


@cache
def _cuda_found() -> bool:
    doctor.require_backend()
    import drjit

    return bool(drjit.has_backend(drjit.JitBackend.CUDA))


def backend() -> str:
    """The ray tracer's backend in force: ``cpu`` or ``cuda``.

    The innermost :func:`use_backend` of this thread wins, then the environment variable
    ``INVERTWIN_BACKEND``, then ``auto``: CUDA where Dr.Jit finds it, the CPU elsewhere.

    Raises:
        InputError: An unknown name, or CUDA without a GPU.
    """
    if _thread.backends:
        return _thread.backends[-1]
    return _resolve_backend(os.environ.get("INVERTWIN_BACKEND", "auto"))


def _resolve_backend(name: str) -> str:
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
    _thread.backends.append(backend() if name is None else _resolve_backend(name))
    _switch_types()
    try:
        yield
    finally:
        _thread.backends.pop()
        _switch_types()


def _switch_types() -> None:
    if _thread.is_tracing:
        mi.switch_types(backend())


@contextmanager
def tracing(name: str | None = None) -> Iterator[None]:
    """Enter a block that may use Mitsuba and Dr.Jit: one thread at a time.

    Args:
        name: backend, as for :func:`use_backend`.

    Raises:
        InputError: A process that was forked from one whose ray tracer had been started.
    """
    if _forked:
        raise InputError(
            "expected a process with a ray tracer of its own, got a fork of one that had traced "
            "rays; start processes by multiprocessing.get_context('spawn')"
        )
    with tracer_lock, use_backend(name):
        outer = _thread.is_tracing
        _thread.is_tracing = True
        _switch_types()
        try:
            yield
            # Wait for pending side effects and kernels of this thread: others would not.
            dr.eval()
            dr.sync_thread()
        finally:
            _thread.is_tracing = outer
            if not outer:
                mi.switch_types(None)


def _after_fork() -> None:
    """Mark a forked child, which lacks the threads of the ray tracer and of torch."""
    global _forked
    _forked = _forked or _load_module.cache_info().currsize > 0
    if _forked:
        torch.set_num_threads(1)


os.register_at_fork(after_in_child=_after_fork)


@cache
def _load_module(module: str, name: str) -> Any:
    doctor.require_backend(name)
    found, drjit = importlib.import_module(module), importlib.import_module("drjit")
    count = threads.available_threads()
    if drjit.thread_count() != count:
        drjit.set_thread_count(count)
    # It has read the environment, unless it was imported before this package.
    if torch.get_num_threads() > count:
        torch.set_num_threads(count)
    return found


class _Mitsuba:
    """Mitsuba, set to the backend in force; imported when it is first used."""

    def __init__(self) -> None:
        self._types: dict[str, dict[str, type]] = {}

    def switch_types(self, backend_name: str | None) -> None:
        """Switch to the types of one backend, or of none outside of tracing.

        Args:
            backend_name: name of the backend, or None.
        """
        types = self._types
        self.__dict__.clear()
        # Kernels look up types a thousand times, so that those in force are plain attributes.
        self.__dict__.update(types.get(backend_name or "", {}), _types=types)

    def __getattr__(self, name: str) -> Any:
        wanted = backend()
        module = _load_module("mitsuba", wanted)
        if module.variant() != VARIANTS[wanted]:
            module.set_variant(VARIANTS[wanted])
        found = getattr(module, name)
        # Types are those of one variant, whichever is set.
        if isinstance(found, type) and _thread.is_tracing:
            self._types.setdefault(wanted, {})[name] = found
            setattr(self, name, found)
        return found


class _DrJit:
    """Dr.Jit, imported when it is first used."""

    def __getattr__(self, name: str) -> Any:
        found = getattr(_load_module("drjit", backend()), name)
        setattr(self, name, found)  # the same for all backends: looked up once
        return found


mi: Any = _Mitsuba()
dr: Any = _DrJit()
