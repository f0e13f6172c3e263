"""Channel to radar data: exact signals and their smooth surrogate, in plain torch."""

from invertwin.radar.backprojection import backproject_beat
from invertwin.radar.boards import BOARDS, Board, board
from invertwin.radar.detection import (
    PointCloud,
    cell_averaging_cfar,
    ordered_statistics_cfar,
    peaks,
    point_cloud,
)
from invertwin.radar.direction import capon, music, source_count
from invertwin.radar.doppler import (
    Spectrogram,
    compensate_tdm,
    micro_doppler,
    range_doppler,
    range_doppler_angle,
    resolve_fold,
    velocity_axis,
    velocity_span,
)
from invertwin.radar.doppler_maps import (
    DopplerMaps,
    Peak,
    doppler_maps,
    points_csv,
    points_of,
    sharp_map,
    snapshots_of,
    still_peak,
)
from invertwin.radar.impairments import (
    ADC,
    Impairments,
    Leakage,
    PhaseNoise,
    channel_errors,
    leakage_signal,
    noisy_oscillator_beat,
    quantize,
    residual_phase,
)
from invertwin.radar.motion import Chirps, moving_beat, range_rate
from invertwin.radar.parameters import ClockOffset, RadarPose, RangeBias
from invertwin.radar.point_spread import airy, dirichlet, normalized_gaussian
from invertwin.radar.radar import Radar
from invertwin.radar.random_phase import random_phase_spectrum
from invertwin.radar.range_profile import add_noise, beat_signal, range_profile
from invertwin.radar.spectrum import beamform, exact_spectrum
from invertwin.radar.surrogate import (
    SURROGATES,
    Surrogate,
    chosen_surrogate,
    surrogate_spectrum,
)
from invertwin.radar.waveform import (
    FMCW,
    OFDM,
    Impulse,
    PhysicsWarning,
    SampledWaveform,
    SteppedFrequency,
    Waveform,
)

__all__ = [
    "ADC",
    "BOARDS",
    "FMCW",
    "OFDM",
    "SURROGATES",
    "Board",
    "Chirps",
    "ClockOffset",
    "DopplerMaps",
    "Impairments",
    "Impulse",
    "Leakage",
    "Peak",
    "PhaseNoise",
    "PhysicsWarning",
    "PointCloud",
    "Radar",
    "RadarPose",
    "RangeBias",
    "SampledWaveform",
    "Spectrogram",
    "SteppedFrequency",
    "Surrogate",
    "Waveform",
    "add_noise",
    "airy",
    "backproject_beat",
    "beamform",
    "beat_signal",
    "board",
    "capon",
    "cell_averaging_cfar",
    "channel_errors",
    "chosen_surrogate",
    "compensate_tdm",
    "dirichlet",
    "doppler_maps",
    "exact_spectrum",
    "leakage_signal",
    "micro_doppler",
    "moving_beat",
    "music",
    "noisy_oscillator_beat",
    "normalized_gaussian",
    "ordered_statistics_cfar",
    "peaks",
    "point_cloud",
    "points_csv",
    "points_of",
    "quantize",
    "random_phase_spectrum",
    "range_doppler",
    "range_doppler_angle",
    "range_profile",
    "range_rate",
    "residual_phase",
    "resolve_fold",
    "sharp_map",
    "snapshots_of",
    "source_count",
    "still_peak",
    "surrogate_spectrum",
    "velocity_axis",
    "velocity_span",
]
