"""Where the command line begins: an interruption is one line, also while modules are imported."""

from invertwin.errors import interruptible


def main() -> None:
    """Run the command line."""
    with interruptible():
        from invertwin.cli import app

        app.main()


if __name__ == "__main__":
    main()
