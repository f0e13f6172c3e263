"""A process that runs the code of one page after another.

Importing PyTorch and Mitsuba takes longer than most pages. The process is spawned: a fork of one in
which PyTorch has started threads hangs. Each page is a main program of its own, in a folder of its
own, and every warning is an error.
"""

import contextlib
import io
import multiprocessing
import os
import sys
import warnings
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from types import ModuleType


class PageRunner:
    """Pages one after another in one process.

    Attributes:
        pool: The process.
    """

    def __init__(self, pool: ProcessPoolExecutor) -> None:
        self.pool = pool

    def run(self, code: str, folder: Path) -> str:
        """Run the code of a page as a main program.

        Args:
            code: All cells of the page.
            folder: The current folder meanwhile.

        Returns:
            All that it prints.
        """
        return self.pool.submit(execute, code, str(folder)).result()


@contextlib.contextmanager
def start_page_runner() -> Iterator[PageRunner]:
    """Start the process; end it afterwards."""
    # Not a Pool: its workers may not start workers of their own, as data sets do.
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        yield PageRunner(pool)


def execute(code: str, folder: str) -> str:
    """Run a main program in the present process, which keeps none of its names and paths."""
    paths, main, printed = sys.path[:], sys.modules["__main__"], io.StringIO()
    sys.modules["__main__"] = ModuleType("__main__")
    os.chdir(folder)
    try:
        with contextlib.redirect_stdout(printed), warnings.catch_warnings():
            warnings.simplefilter("error")
            # torch says so about itself when forward-mode derivatives are first used.
            warnings.filterwarnings("ignore", "`torch.jit.script` is dep", DeprecationWarning)
            exec(compile(code, "page", "exec"), sys.modules["__main__"].__dict__)
    except BaseException as error:
        error.add_note(printed.getvalue()[-3000:])
        raise
    finally:
        sys.path[:], sys.modules["__main__"] = paths, main
    return printed.getvalue()
