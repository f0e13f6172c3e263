"""Scene to paths to channel impulse response: the only room that knows the ray tracer."""

from invertwin.channel.field.field import trace_field
from invertwin.channel.field.rough_paths import RoughPaths
from invertwin.channel.field.rough_points import RoughPoints
from invertwin.channel.field.speckle import Speckle, draw_speckle
from invertwin.channel.paths import Grid, Link, Paths, Pattern
from invertwin.channel.power.clouds import deposit_density
from invertwin.channel.power.deposit import deposit_power
from invertwin.channel.rays.backend import backend, use_backend
from invertwin.channel.rays.geometry import differentiated
from invertwin.channel.rays.scene import visible_points
from invertwin.channel.reference.power import trace_power
from invertwin.channel.sampling import Sampling

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
    "visible_points",
]
