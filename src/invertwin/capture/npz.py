"""Arrays of an npz file, or an error that says what is wrong with it."""

import zipfile
import zlib
from pathlib import Path

import numpy as np

from invertwin.errors import InputError


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """Every array of a file, by name.

    Raises:
        InputError: no such file, or a damaged one.
    """
    if not path.is_file():
        raise InputError(
            f"expected {path.name} in {path.parent}, got no such file; check the folder"
        )
    try:
        # Opened here, since np.load leaves a file open that it cannot read.
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(
            f"expected a whole npz file, got {path}, which cannot be read "
            f"({type(error).__name__}); it is damaged or truncated, copy it again"
        ) from error
