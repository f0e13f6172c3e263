"""Channel to radar data: the exact signal chain and its smooth surrogate, in plain torch."""

from invertwin.radar.motion import Chirps, moving_beat
from invertwin.radar.range_profile import add_noise, beat_signal, range_profile
from invertwin.radar.spectrum import beamform, exact_spectrum
from invertwin.radar.surrogate import Surrogate, airy, normalized_gaussian, surrogate_spectrum
from invertwin.radar.waveform import FMCW, Impulse, PhysicsWarning, Radar

__all__ = [
    "FMCW",
    "Chirps",
    "Impulse",
    "PhysicsWarning",
    "Radar",
    "Surrogate",
    "add_noise",
    "airy",
    "beamform",
    "beat_signal",
    "exact_spectrum",
    "moving_beat",
    "normalized_gaussian",
    "range_profile",
    "surrogate_spectrum",
]
