"""Which antenna elements a recording was made with."""

from invertwin.capture.chirps import ChirpSettings
from invertwin.errors import InputError
from invertwin.radar.boards import board as preset
from invertwin.scene.antenna import AntennaArray


def elements(
    settings: ChirpSettings,
    board: str | None,
    elevation: int | None,
    azimuth: int,
    arrays: tuple[AntennaArray, AntennaArray] | None,
) -> tuple[AntennaArray, AntennaArray]:
    """TX and RX elements in use: those given, or those of a preset that the settings name.

    Transmitters come in the order of sending.

    Args:
        settings: chirp settings, which name antennas.
        board: name of a preset, or None.
        elevation: as in `Board.arrays`.
        azimuth: as in `Board.arrays`.
        arrays: (transmitters, receivers) instead of a preset, or None.

    Raises:
        InputError: neither or both, or what the preset refuses.
    """
    if (board is None) == (arrays is None):
        raise InputError(
            f"expected either board or arrays, got {'both' if arrays else 'neither'}; "
            "name a preset of invertwin.radar.boards, or give (transmitters, receivers)"
        )
    if arrays is not None:
        return arrays
    assert board is not None
    return preset(board).arrays(
        elevation=elevation,
        azimuth=azimuth,
        transmitters=settings.transmit_order,
        receivers=settings.receivers,
    )
