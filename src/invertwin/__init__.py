"""Digital twins from radar: differentiable ray-traced radar simulation, visibility included.

The names below are the public menu. Each is loaded when it is first used, so ``import invertwin``
is quick, and ``invertwin doctor`` runs where no ray tracer can.
"""

from importlib import import_module
from typing import Any

from invertwin import doctor

__version__ = "0.1.0"

# Name → module.
_MENU: dict[str, str] = {}

__all__ = ["__version__", *_MENU]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _MENU:
        raise AttributeError(f"module 'invertwin' has no attribute {name!r}")
    value = getattr(import_module(f"invertwin.{_MENU[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_MENU})


# Dr.Jit picks its libLLVM while it is being imported: before any module can do that.
doctor.prepare()
