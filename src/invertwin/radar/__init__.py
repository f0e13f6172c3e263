"""Channel to radar data: the exact signal chain and its smooth surrogate, in plain torch."""

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
from invertwin.radar.motion import Chirps, moving_beat
from invertwin.radar.range_profile import add_noise, beat_signal, range_profile
from invertwin.radar.spectrum import beamform, exact_spectrum
from invertwin.radar.surrogate import Surrogate, airy, normalized_gaussian, surrogate_spectrum
from invertwin.radar.waveform import (
    FMCW,
    OFDM,
    Impulse,
    PhysicsWarning,
    Radar,
    SampledWaveform,
    SteppedFrequency,
    Waveform,
)

__all__ = [
    "ADC",
    "FMCW",
    "OFDM",
    "Chirps",
    "Impairments",
    "Impulse",
    "Leakage",
    "PhaseNoise",
    "PhysicsWarning",
    "Radar",
    "SampledWaveform",
    "SteppedFrequency",
    "Surrogate",
    "Waveform",
    "add_noise",
    "airy",
    "beamform",
    "beat_signal",
    "channel_errors",
    "exact_spectrum",
    "leakage_signal",
    "moving_beat",
    "noisy_oscillator_beat",
    "normalized_gaussian",
    "quantize",
    "range_profile",
    "residual_phase",
    "surrogate_spectrum",
]
