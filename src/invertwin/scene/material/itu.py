"""Building materials and grounds of Recommendation ITU-R P.2040-3."""

import difflib
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from invertwin.checks import checked_number
from invertwin.constants import read_table
from invertwin.errors import InputError


class OutsideTableWarning(UserWarning):
    """Warning about a material outside the frequency range of its table."""


class Coefficients(NamedTuple):
    """Coefficients of ε' = a f^b and σ = c f^d [S/m], f in GHz, from `low` to `high` [GHz]."""

    low: float
    high: float
    a: float
    b: float
    c: float
    d: float


ITU_MATERIALS: Mapping[str, tuple[Coefficients, ...]] = {
    name: tuple(Coefficients(*row) for row in rows)
    for name, rows in read_table("invertwin.scene.material", "itu.toml").items()
}
"""Table of the recommendation by name, with one entry per frequency range.

Source: ITU-R P.2040-3 (2023), §3, table of material properties."""

_warned: set[str] = set()


@dataclass(frozen=True)
class Itu:
    """Permittivity or conductivity of a material of the table at the frequency of the radar.

    It replaces the number in a material's `permittivity` or `conductivity`; the constructor `itu`
    of the materials sets both.

    Attributes:
        name: one of `ITU_MATERIALS`.

    Raises:
        InputError: an unknown name (the nearest ones are named).
    """

    name: str

    def __post_init__(self) -> None:
        if self.name in ITU_MATERIALS:
            return
        plain = str(self.name).strip().lower().replace(" ", "_").replace("-", "_")
        near = difflib.get_close_matches(plain, ITU_MATERIALS, cutoff=0.5)
        do = f"did you mean {' or '.join(near)}?" if near else f"use {', '.join(ITU_MATERIALS)}"
        raise InputError(f"expected a material of ITU-R P.2040, got {self.name!r}; {do}")

    def coefficients(self, frequency: float) -> Coefficients:
        """Return the entry of the table for `frequency` [Hz]; outside all, the nearest, with a
        warning.

        The warning (`OutsideTableWarning`) is issued once per material.

        Raises:
            InputError: a frequency that is not positive.
        """
        ghz = checked_number(frequency, "frequency [Hz]", 0.0, open_low=True) / 1e9
        entries = ITU_MATERIALS[self.name]
        found = min(entries, key=lambda entry: max(entry.low / ghz, ghz / entry.high))
        if not found.low <= ghz <= found.high and self.name not in _warned:
            _warned.add(self.name)
            stated = " and ".join(f"{entry.low:g} to {entry.high:g}" for entry in entries)
            warnings.warn(
                f"ITU-R P.2040 states {self.name} from {stated} GHz, got {ghz:g} GHz; "
                "its formula is used outside: give measured values if you have some",
                OutsideTableWarning,
                stacklevel=2,
            )
        return found

    def permittivity(self, frequency: float) -> float:
        """Return the real part ε' of the relative permittivity at `frequency` [Hz]."""
        entry = self.coefficients(frequency)
        return entry.a * (frequency / 1e9) ** entry.b

    def conductivity(self, frequency: float) -> float:
        """Return the conductivity σ [S/m] at `frequency` [Hz]."""
        entry = self.coefficients(frequency)
        return entry.c * (frequency / 1e9) ** entry.d
