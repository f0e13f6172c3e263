"""One function for all recordings that the library reads."""

from pathlib import Path

from invertwin.capture import ti
from invertwin.capture.capture import Capture
from invertwin.capture.chirp_capture import ChirpCapture
from invertwin.capture.chirps import ChirpSettings
from invertwin.capture.readers import described_arrays, described_sweeps
from invertwin.radar.boards import Mounting, TxRxArrays
from invertwin.refusals import refusal


def read(
    path: str | Path,
    settings: str | Path | ChirpSettings | None = None,
    *,
    board: Mounting | TxRxArrays | None = None,
    lanes: int | None = None,
    trusted: bool = False,
) -> Capture | ChirpCapture:
    """Read a recording, as the ending of its file says.

    A `.nc` is a saved capture. A `.toml` describes samples in files beside it: sweeps where it has
    a section ``[sweep]`` (`described_sweeps.read_sweeps`), else chirps
    (`described_arrays.read_chirps`). A `.s1p` or `.s2p` is a sweep of a network analyser. A `.bin`
    or `.setup.json` comes from a DCA1000 (`ti.read_recording`).

    Args:
        path: the file.
        settings: settings of a `.bin`, or their file: `.cfg` or `.mmwave.json`.
        board: whose elements recorded, or (transmitters, receivers), see `ChirpData.recorded`;
            None = as the description says.
        lanes: lanes of the LVDS link, where the settings do not say.
        trusted: read HDF5, NetCDF and MATLAB files in this process, not in a child process.

    Returns:
        One signal per frame and channel, or every chirp of the frames: `ChirpCapture.capture`
        makes one signal of them.

    Raises:
        InputError: another ending, no board, or what the reader raises.
    """
    ending = Path(path).suffix.lower()
    if ending == ".nc":
        return Capture.load(path, trusted=trusted)
    if is_sweeps(path):
        return described_sweeps.read_sweeps(path, trusted=trusted)
    if ending == ".toml":
        chirps = described_arrays.read_chirps(path, trusted=trusted)
        return chirps.to_chirp_capture(board or described_arrays.load_described_board(path))
    if ending not in (".bin", ".json"):
        raise refusal("read.ending", path)
    if board is None:
        raise refusal("read.board")
    return ti.read_recording(path, settings, lanes).to_chirp_capture(board)


def is_sweeps(path: str | Path) -> bool:
    """Return True for sweeps over frequency: a Touchstone file, or a description of sweeps.

    Args:
        path: the file.

    Raises:
        InputError: a description that does not exist.
    """
    ending = Path(path).suffix.lower()
    if ending == ".toml":
        return described_sweeps.describes_sweeps(path)
    return described_sweeps.TOUCHSTONE.fullmatch(ending) is not None
