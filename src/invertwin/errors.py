"""The one exception type for bad input, raised at the public edge, and the one warning.

And what the command line says when it is interrupted.
"""

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_MAX_LENGTH = 8_000  # characters of a line


class InputError(ValueError):
    """Bad input, in one line: expected value, given value, remedy.

    The command line prints it without a traceback and exits with code 2.
    """

    def __init__(self, text: str, at: str = "") -> None:
        """Say what is wrong.

        Args:
            text: The line.
            at: The argument that it is about: the key of a run file.
        """
        super().__init__(to_one_line(text))
        self.at = at


class PhysicsWarning(UserWarning):
    """The input is valid, but its result will not mean what one may expect."""


@contextmanager
def locate_errors(where: object) -> Iterator[None]:
    """Put the place of a fault before the text of an InputError.

    Args:
        where: The place, such as the path of a file; what ``str`` makes of it is shown.

    Raises:
        InputError: The block has raised one.
    """
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def import_optional(package: str, extra: str) -> Any:
    """Import a package that comes with an extra only.

    Args:
        package: Its name.
        extra: The extra of ours.

    Raises:
        InputError: It is not installed.
    """
    try:
        return importlib.import_module(package)
    except ImportError:
        raise InputError(
            f"expected the package {package}, got none; type: pip install 'invertwin[{extra}]'"
        ) from None


def to_one_line(text: str) -> str:
    """A text that a terminal shows as it is: one line, no control characters, not endless.

    Args:
        text: May hold what strangers wrote, such as names from a file.
    """
    if not text.isprintable():
        text = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in " ".join(text.split()))
    if len(text) > _MAX_LENGTH:
        text = f"{text[: _MAX_LENGTH // 2]} … {text[-_MAX_LENGTH // 2 :]}"
    return text


@contextmanager
def exit_on_interrupt() -> Iterator[None]:
    """End the program with one line and exit code 130 on Ctrl-C."""
    try:
        yield
    except KeyboardInterrupt:
        print("invertwin: interrupted", file=sys.stderr)
        sys.exit(130)
