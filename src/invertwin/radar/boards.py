"""Radar boards: element positions of commercial evaluation modules.

Element positions are nominal ones from layouts published by TI and in open code, on a grid of half
wavelengths at the design frequency of the board. Electrical phase centres differ by fractions of a
millimetre: estimate them with a reflector (`invertwin.capture.estimate_channels`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Annotated

import torch
from annotated_types import Len, MinLen
from torch import Tensor

from invertwin.checks import ArrayLike, check_choice, check_fields, checked_tensor
from invertwin.constants import SPEED_OF_LIGHT, read_table
from invertwin.errors import InputError
from invertwin.limits import AllowedValues, Frequency, Positive
from invertwin.scene.antenna import AntennaArray, Isotropic, Pattern, Polarised

TxRxArrays = tuple[AntennaArray, AntennaArray]  # TX and RX
ElementGrid = Annotated[Sequence[Annotated[Sequence[float], Len(2, 2)]], MinLen(1)]
_Numbers = Sequence[int] | None  # of elements from 1; None = all


@dataclass(frozen=True)
class Board:
    """Element positions of a board in half wavelengths.

    Columns and rows are those of the source, except that the sign of the columns of
    ``antGeometry0`` is reversed, so that they grow with the element numbers. Define other boards by
    a new ``Board``.

    A drawing of the antenna side shows the board as a person sees it who faces the radar. Its right
    is the left of the radar, which looks out: columns lie along y and rows along z.

    Differs from the source: the sources count the columns and rows of TX and of RX from separate
    origins of unknown distance. Here TX and RX are each centred at the origin of the radar frame,
    which shifts the radar by up to about a centimetre.

    Attributes:
        name: name of the board.
        transmitters: (column, row) of TX1, TX2, … [λ/2].
        receivers: (column, row) of RX1, RX2, … [λ/2].
        design_frequency: frequency whose half wavelength is the unit [Hz]. Presets without one in
            their source use the middle of the band (xWR1642, xWR1843, AWR2944), or that of a
            similar board, the IWR6843L of TI's SWRU585 (IWR6843ISK, IWR6843AOP).
        source: reference of the numbers.
        polarisation: polarisation of all elements, as in `AntennaArray`. The sources of the presets
            state none: V is assumed.

    Raises:
        InputError: no elements, positions that are not pairs of numbers, or a frequency that is not
            in Hz.
    """

    name: str
    transmitters: ElementGrid
    receivers: ElementGrid
    design_frequency: Frequency
    source: str = "user"
    polarisation: Polarised = "V"

    def __post_init__(self) -> None:
        check_fields(self)
        do = "give one pair in half wavelengths per element"
        for end in ("transmitters", "receivers"):
            what = f"{end} of {self.name} as pairs (column, row)"
            pairs = checked_tensor(getattr(self, end), (None, 2), what, do)
            object.__setattr__(self, end, tuple(map(tuple, pairs.tolist())))

    @property
    def has_rows(self) -> bool:
        """True if the board resolves elevation, so that the sign of elevation matters."""
        return any(len({row for _, row in end}) > 1 for end in (self.transmitters, self.receivers))

    def arrays(
        self,
        *,
        elevation: int | None = None,
        azimuth: int = 1,
        transmitters: _Numbers = None,
        receivers: _Numbers = None,
        pattern: Pattern | None = None,
        polarisation: Polarised | None = None,
        leakage: float | ArrayLike = 0.0,
    ) -> TxRxArrays:
        """Return TX and RX elements in the radar frame (x boresight, y left, z up).

        Public sources disagree on the upward direction, for example for the xWR1843's middle
        transmitter, and on the sign of phases. So the sign of elevation has no default where it
        matters. To determine it, place a reflector above the board: its spectrum must peak at v >
        0. Likewise a reflector to the left of the radar must peak at u > 0.

        Args:
            elevation: +1 = rows grow upwards (z), −1 = downwards; required if the board has rows.
            azimuth: +1 = columns grow to the left of the radar (y), the right of a person who faces
                it; −1 = to its right.
            transmitters: numbers from 1 of the active elements, in this order; None = all.
            receivers: numbers from 1 of the active RX elements; None = all.
            pattern: gain of every element, isotropic by default.
            polarisation: polarisation of every element; None = the board's.
            leakage: field of the orthogonal polarisation over that of the nominal one.

        Returns:
            transmitters, receivers.

        Raises:
            InputError: a missing or wrong sign, or an element that the board does not have.
        """
        if elevation is None and self.has_rows:
            raise InputError(
                f"expected elevation=+1 or -1 for {self.name}, got none; public sources disagree "
                "which way its rows grow: try a reflector above the board, which must be at v > 0"
            )
        signs = (azimuth, 1 if elevation is None else elevation)
        for name, sign in zip(("azimuth", "elevation"), signs, strict=True):
            if sign not in (-1, 1):
                raise InputError(f"expected {name} to be +1 or -1, got {sign!r}; it is a sign")
        unit = SPEED_OF_LIGHT / self.design_frequency / 2
        pattern = Isotropic() if pattern is None else pattern

        def array(grid_positions: ElementGrid, numbers: _Numbers, name: str) -> AntennaArray:
            grid = torch.tensor(grid_positions, dtype=torch.float64)
            grid = (grid - grid.mean(dim=0)) * torch.tensor(signs, dtype=torch.float64) * unit
            positions = torch.cat([torch.zeros_like(grid[:, :1]), grid], dim=1)
            own = self.polarisation if polarisation is None else polarisation
            chosen = positions[self._indices(grid_positions, numbers, name)]
            return AntennaArray(chosen, pattern, own, leakage)

        return array(self.transmitters, transmitters, "TX"), array(self.receivers, receivers, "RX")

    def _indices(self, positions: ElementGrid, chosen: _Numbers, name: str) -> Tensor:
        numbers = list(range(1, len(positions) + 1)) if chosen is None else list(chosen)
        wrong = [number for number in numbers if not 1 <= number <= len(positions)]
        if wrong or not numbers or len(set(numbers)) < len(numbers):
            raise InputError(
                f"expected different {name} numbers of {self.name} from 1 to {len(positions)}, got "
                f"{numbers}; choose elements that it has"
            )
        return torch.tensor(numbers) - 1


@dataclass(frozen=True)
class Mounting:
    """Mounted board with its active elements.

    Attributes:
        board: board, or name of a preset.
        elevation, azimuth: as in `Board.arrays`.
        transmitters: numbers from 1 in the order of transmission; None = all, or those of a
            recording.
        receivers: numbers from 1, ascending; None = all, or those of a recording.
        pattern: gain of every element; None = isotropic.
        polarisation: polarisation of every element; None = the board's.
        leakage: field of the orthogonal polarisation over that of the nominal one.
    """

    board: Board | str
    elevation: int | None = None
    azimuth: int = 1
    transmitters: _Numbers = None
    receivers: _Numbers = None
    pattern: Pattern | None = None
    polarisation: Polarised | None = None
    leakage: float = 0.0

    def arrays(self, transmitters: _Numbers = None, receivers: _Numbers = None) -> TxRxArrays:
        """Return active TX (in the order of transmission) and RX elements: its own, or those of a
        recording.

        Args:
            transmitters: numbers of the transmitters of the recording, in the order of
                transmission.
            receivers: numbers of the receivers of the recording, ascending.

        Raises:
            InputError: as `Board.arrays`, or active elements given both here and by a recording.
        """
        for name, recorded in (("transmitters", transmitters), ("receivers", receivers)):
            given = getattr(self, name)
            if recorded is not None and given is not None:
                raise InputError(
                    f"expected no `{name}` with a recording, got {list(given)}; remove the key: "
                    f"the recording's settings say {list(recorded)}"
                )
        found = board(self.board) if isinstance(self.board, str) else self.board
        how = {name: value for name, value in vars(self).items() if name != "board"}
        how["transmitters"] = transmitters or self.transmitters
        how["receivers"] = receivers or self.receivers
        return found.arrays(**how)


_TABLES = read_table("invertwin.radar", "boards.toml")
BOARDS: Mapping[str, Board] = MappingProxyType({n: Board(n, **t) for n, t in _TABLES.items()})
"""Name → preset. xWR boards serve the AWR and the IWR of that number."""


def board(
    name: Annotated[str, AllowedValues(tuple(BOARDS))], design_frequency: Positive | None = None
) -> Board:
    """Return a preset of `BOARDS`.

    Args:
        name: name of a preset; xWR covers AWR and IWR.
        design_frequency: frequency whose half wavelength is the unit [Hz]; None = the preset's.

    Raises:
        InputError: an unknown name.
    """
    check_choice(name, BOARDS, "a board of", "describe another one as a Board with its own table")
    found = BOARDS[name]
    return found if design_frequency is None else replace(found, design_frequency=design_frequency)
