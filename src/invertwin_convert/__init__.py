"""`invertwin convert`: run files of the first frame, rewritten in place.

A package of its own, which goes once nobody has such files: the library never reads them.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from invertwin_convert.run_files import convert_file, write_files


def run_convert(files: Sequence[Path]) -> list[str]:
    """Rewrite run files; return what is said of each. Where one is refused, all stay.

    Args:
        files: Of the first frame.

    Raises:
        InputError: One that cannot be converted.
    """
    texts: dict[Path, str] = {}
    images: dict[Path, np.ndarray] = {}
    for file in files:
        texts[file], found = convert_file(file)
        images |= found
    write_files(texts, images)
    return [f"{path}: written" for path in (*images, *texts)]
