"""The tables of a recording of movers, and of the body that is sought in it."""

from typing import Literal

from invertwin.cli.schema.section import Count, InputPath, Section
from invertwin.cli.schema.sensor import Board, PresetBoard


class OpenRadarData(Section):
    """The public 77 GHz recording of movers, with every chirp; what is sought is a `mover`."""

    kind: Literal["openradar"]
    folder: InputPath
    """path, from the run file's folder, then from INVERTWIN_DATA"""
    board: Board = PresetBoard(name="xWR1642")
    """whose elements recorded; the file does not say"""


class MoverParameter(Section):
    """Place, size, velocity, turn and diffuse share of a rough body in motion.

    Starts at the strongest echo that moves, with the object's size; only with data of kind
    `openradar`.
    """

    kind: Literal["mover"]
    object: str
    """name in the scene"""
    cells: Count = 6
    """range and Doppler cells to either side of the echo that are fitted"""
