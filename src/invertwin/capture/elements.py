"""Which antenna elements a recording was made with."""

from invertwin.capture.chirps import ChirpSettings
from invertwin.errors import InputError
from invertwin.radar.boards import Mounting
from invertwin.radar.boards import board as preset
from invertwin.scene.antenna import AntennaArray


def elements(
    settings: ChirpSettings,
    board: str | Mounting | None,
    elevation: int | None = None,
    azimuth: int = 1,
    arrays: tuple[AntennaArray, AntennaArray] | None = None,
) -> tuple[AntennaArray, AntennaArray]:
    """TX and RX elements in use: those given, or those of a board that the settings name.

    Transmitters come in the order of sending.

    Args:
        settings: chirp settings, which name antennas.
        board: as it is mounted, or the name of a preset, or None.
        elevation: of the preset, as in `Board.arrays`.
        azimuth: of the preset, as in `Board.arrays`.
        arrays: (transmitters, receivers) instead of a preset, or None.

    Raises:
        InputError: neither or both, or what the board refuses.
    """
    if (board is None) == (arrays is None):
        raise InputError(
            f"expected either board or arrays, got {'both' if arrays else 'neither'}; "
            "name a preset of invertwin.radar.boards, or give (transmitters, receivers)"
        )
    if arrays is not None:
        return arrays
    if not isinstance(board, Mounting):
        board = Mounting(preset(str(board)), elevation, azimuth)
    return board.arrays(settings.transmit_order, settings.receivers)
