"""The one exception type for bad input, raised at the public edge."""


class InputError(ValueError):
    """What was expected, what came, and what to do, in one line.

    The command line prints it without a traceback and exits with code 2.
    """
