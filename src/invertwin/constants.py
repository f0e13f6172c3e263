"""Physical constants in SI units (CODATA 2018), tables of data, and the mark of our axes."""

import tomllib
from functools import cache
from importlib.resources import files
from typing import Any

SPEED_OF_LIGHT = 299_792_458.0  # m/s
VACUUM_PERMITTIVITY = 8.854_187_812_8e-12  # F/m
BOLTZMANN = 1.380_649e-23  # J/K

FRAME = 2
"""Mark of the axes x forward, y left, z up. Files without one have x left, y up, z ahead."""
OLD_AXES = (2, 0, 1)
"""Places of x forward, y left, z up among the axes of a file without a mark."""


@cache
def read_table(package: str, name: str) -> dict[str, Any]:
    """Read a TOML table of data that lies beside the modules of a package, once.

    Args:
        package: such as ``invertwin.radar``.
        name: name of the file.
    """
    return tomllib.loads(files(package).joinpath(name).read_text(encoding="utf-8"))
