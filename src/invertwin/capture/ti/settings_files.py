"""Settings files are told apart by their ending."""

from pathlib import Path

from invertwin.capture.chirps import ChirpSettings
from invertwin.capture.ti.mmwave_studio import read_studio, setup_files
from invertwin.capture.ti.sdk_cfg import read_cfg
from invertwin.errors import InputError


def read_settings(path: str | Path) -> ChirpSettings:
    """Read the settings of a `.cfg`, `.mmwave.json` or `.setup.json` file.

    Raises:
        InputError: another ending, or what the reader of that file raises.
    """
    endings = {".cfg": read_cfg, ".json": read_studio}
    ending = Path(path).suffix.lower()
    if ending not in endings:
        raise InputError(
            f"expected settings in a .cfg or .json file, got {path}; "
            "name the file the recording was set up with"
        )
    return endings[ending](path)


def recorded_files(path: str | Path) -> list[Path]:
    """The `.bin` files of a recording: the file itself, or those that a `.setup.json` names."""
    return setup_files(path) if Path(path).suffix.lower() == ".json" else [Path(path)]
