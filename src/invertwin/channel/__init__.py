"""Scene to paths to channel impulse response: the only room that knows the ray tracer."""

from invertwin.channel.bridge import backend, use_backend
from invertwin.channel.chains import RoughChains, rough_chains
from invertwin.channel.density import deposit_density
from invertwin.channel.deposit import deposit_power
from invertwin.channel.paths import Grid, Link, Paths, Pattern
from invertwin.channel.tracer import RoughPoints, rough_points, trace_field, trace_power

__all__ = [
    "Grid",
    "Link",
    "Paths",
    "Pattern",
    "RoughChains",
    "RoughPoints",
    "backend",
    "deposit_density",
    "deposit_power",
    "rough_chains",
    "rough_points",
    "trace_field",
    "trace_power",
    "use_backend",
]
