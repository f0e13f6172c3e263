"""Scene to paths to channel impulse response: the only room that knows the ray tracer."""

from invertwin.channel.bridge import backend, differentiated, use_backend
from invertwin.channel.chains import RoughPaths
from invertwin.channel.density import deposit_density
from invertwin.channel.deposit import deposit_power
from invertwin.channel.paths import Grid, Link, Paths, Pattern
from invertwin.channel.sampling import Sampling
from invertwin.channel.tracer import (
    RoughPoints,
    Speckle,
    draw_speckle,
    trace_field,
    trace_power,
)

__all__ = [
    "Grid",
    "Link",
    "Paths",
    "Pattern",
    "RoughPaths",
    "RoughPoints",
    "Sampling",
    "Speckle",
    "backend",
    "deposit_density",
    "deposit_power",
    "differentiated",
    "draw_speckle",
    "trace_field",
    "trace_power",
    "use_backend",
]
