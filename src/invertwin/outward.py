"""How values show themselves: the one call against the arrows between rooms.

A scene knows nothing of figures or browsers. What draws it is found by its name in ``viewer`` when
somebody first asks.
"""

from importlib import import_module
from typing import Any


def shown_by(name: str, value: object, **options: Any) -> Any:
    """What a function of ``viewer`` makes of a value.

    Args:
        name: Of the function.
        value: What is shown.
        options: Further arguments.
    """
    return getattr(import_module("invertwin.viewer"), name)(value, **options)
