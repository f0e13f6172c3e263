"""The tables of recordings: chirp trains, front ends, raw files written and read."""

from typing import Annotated, Literal

from pydantic import Field

from invertwin.cli.schema.section import InputPath, NonNegative, Positive, Section
from invertwin.cli.schema.sensor import Board, Orientation, Track

Lanes = Literal[2, 4]


class Chirps(Section):
    """Several ramps a frame: objects move between them, and range rates are resolved."""

    count: Annotated[int, Field(ge=2)]
    """ramps of each transmitter in a frame (loops)"""
    interval: Positive
    """s, from ramp to ramp, idle time included"""
    tdm: bool = True
    """transmitters take turns; false = at once, told apart by an ideal code"""
    retrace: bool = False
    """trace rays anew at every ramp, instead of moving what is seen at the start of the frame"""


class Raw(Section):
    """Raw files as other tools read them: DCA1000 samples, SDK and mmWave Studio settings."""

    lanes: Lanes = 2
    """of the LVDS link: 4 for xWR12xx and xWR14xx, 2 for later ones"""
    real: bool = False
    """real samples instead of I and Q"""
    bits: Literal[12, 14, 16] = 16
    """of the ADC"""
    full_scale: Positive | None = None
    """√(received over sent power) of the largest count; without it 1.25 times the largest sample"""
    adc_start_time: NonNegative = 0.0
    """s, from the start of the ramp to the first sample; the waveform is what is sampled"""
    frame_period: Positive | None = None
    """s, from frame to frame, as the settings say it"""


class PhaseNoise(Section):
    """Of the oscillator that sends and mixes."""

    offsets: Annotated[list[Positive], Field(min_length=1)]
    """Hz from the carrier, ascending; a single one stands for −20 dB per decade"""
    levels: Annotated[list[float], Field(min_length=1)]
    """dBc/Hz at the offsets"""


class Leakage(Section):
    """Directly from transmitters to receivers."""

    delay: NonNegative
    """s"""
    level_db: Annotated[float, Field(lt=0)]
    """received over sent power"""


class Adc(Section):
    """Converter of I and of Q."""

    bits: Annotated[int, Field(ge=2, le=32)]
    """of each"""
    full_scale: Positive
    """amplitude that still fits, √(received over sent power)"""


class Impairments(Section):
    """What a front end adds to simulated data beside the noise of [data]; each off by default."""

    phase_noise: PhaseNoise | None = None
    """of the common oscillator"""
    leakage: Leakage | None = None
    """from transmitters to receivers"""
    gain_std_db: NonNegative = 0.0
    """standard deviation of the channels' gains"""
    phase_std_deg: NonNegative = 0.0
    """standard deviation of the channels' phases"""
    transmit_power: Positive = 0.01
    """W of one transmitter, for the noise figure"""
    adc: Adc | None = None
    """converter"""


class Recording(Section):
    """Raw chirps of a board, made one signal per frame."""

    chirp: Annotated[int, Field(ge=0)] | None = None
    """number from 0 of one; without it the mean of a frame's, in which movers fade"""
    positions: Track | None = None
    """m, of the radar in every frame, or one for all; without it the origin"""
    orientation: Orientation | None = None
    """look_at or rotation_deg; without it the axes of the world"""
    channels: InputPath | None = None
    """channel calibration that `invertwin look --reflector` wrote; divided out"""


class Dca1000Data(Recording):
    """A recording of a TI board through the DCA1000."""

    kind: Literal["dca1000"]
    file: InputPath
    """.bin, or the .setup.json that names the files"""
    settings: InputPath | None = None
    """.cfg or .mmwave.json; without it what the .setup.json names"""
    board: Board
    """whose elements recorded; those in use are what the settings say"""
    lanes: Lanes | None = None
    """of the LVDS link, where the settings do not say"""


class ArraysData(Recording):
    """Samples in a NumPy, HDF5 or MATLAB file with a TOML description beside it."""

    kind: Literal["arrays"]
    file: InputPath
    """the description"""
    board: Board | None = None
    """whose elements recorded; without it what the description says"""
