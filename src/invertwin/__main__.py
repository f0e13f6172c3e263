"""Entry point of the command line. An interruption prints one line, also during imports."""

import os
import sys
from io import TextIOWrapper

from invertwin.errors import exit_on_interrupt


def main() -> None:
    """Run the command line."""
    # Where a standard stream is closed, the next file that is opened would get its number.
    while (handle := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(handle)
    sys.stdout, sys.stderr = sys.stdout or os.fdopen(1, "w"), sys.stderr or os.fdopen(2, "w")
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal of ASCII has no ² and no frames
    with exit_on_interrupt():
        from invertwin.cli import app

        app.main()


if __name__ == "__main__":
    main()
