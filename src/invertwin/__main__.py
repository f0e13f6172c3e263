"""Entry point of the command line. An interruption prints one line, also during imports."""

from invertwin.errors import exit_on_interrupt


def main() -> None:
    """Run the command line."""
    with exit_on_interrupt():
        from invertwin.cli import app

        app.main()


if __name__ == "__main__":
    main()
