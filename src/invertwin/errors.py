"""The one exception type for bad input, raised at the public edge."""


class InputError(ValueError):
    """What was expected, what came, and what to do, in one line.

    The command line prints it without a traceback and exits with code 2.
    """

    def __init__(self, text: str, at: str = "") -> None:
        """Say what is wrong.

        Args:
            text: The line.
            at: The argument that it is about: the key of a run file.
        """
        super().__init__(text)
        self.at = at
