"""The recordings as `[data]` kinds of run files."""

from dataclasses import replace
from pathlib import Path

from invertwin.capture import Capture, ChirpCapture
from invertwin.cli.schema.recordings import assign_board
from invertwin.errors import InputError
from invertwin.radar.boards import Mounting
from invertwin.registry.section import InputPath, prefix_errors
from invertwin_studies.recordings import openradar, rail_sar

_ORIGINALS = {
    rail_sar.FILE: "github.com/jjimmykang/bwsi-backprojection, trial 6",
    openradar.FILE: "of github.com/PreSenseRadar/OpenRadar",
}


def rail_sar_data(folder: InputPath) -> Capture:
    """The public recording of an ultra-wideband radar on a rail.

    Args:
        folder: path, from the run file's folder, then from INVERTWIN_DATA.
    """
    with prefix_errors("folder"):
        return rail_sar.read(_holding(rail_sar.FILE, Path(folder)))


def openradar_data(folder: InputPath, board: Mounting | None = None) -> ChirpCapture:
    """The public 77 GHz recording of movers, with every chirp.

    Args:
        folder: path, from the run file's folder, then from INVERTWIN_DATA.
        board: whose elements recorded; the file does not say; without it xWR1642.
    """
    with prefix_errors("folder"):
        chirps = openradar.read_chirps(_holding(openradar.FILE, Path(folder)))
    return replace(assign_board(chirps, board or Mounting("xWR1642")), moving=True)


def _holding(file: str, folder: Path) -> Path:
    if not (folder / file).is_file():
        raise InputError(
            f"expected {file} in {folder}, got no such file; it is made from the public recording "
            f"{_ORIGINALS[file]}: set INVERTWIN_DATA to the folder that holds {folder.name}/"
        )
    return folder
