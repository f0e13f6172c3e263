"""Where the command line begins: an interruption is one line, also while modules are imported."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def interruptible() -> Iterator[None]:
    """End the program with one line and exit code 130 on Ctrl-C."""
    try:
        yield
    except KeyboardInterrupt:
        print("invertwin: interrupted", file=sys.stderr)
        sys.exit(130)


def main() -> None:
    """Run the command line."""
    with interruptible():
        from invertwin.cli import app

        app.main()


if __name__ == "__main__":
    main()
