"""Matplotlib figures of what the package computes: maps, scenes, fits.

Every function returns a `matplotlib.figure.Figure`, drawn without pyplot, so that nothing global
changes: save it with ``figure.savefig(path)`` or show it in a notebook. The turntable is an
animation and comes as the bytes of a GIF.
"""

from invertwin.plotting.curves import convergence, count_minima, landscape
from invertwin.plotting.figures import PALETTE, png_bytes
from invertwin.plotting.maps import (
    RATE_LABEL,
    U_LABEL,
    V_LABEL,
    Panel,
    direction_panels,
    doppler_panels,
    gradient,
    panels,
    range_doppler,
    spectrum,
)
from invertwin.plotting.scenes import scene
from invertwin.plotting.turntable import turntable

__all__ = [
    "PALETTE",
    "RATE_LABEL",
    "U_LABEL",
    "V_LABEL",
    "Panel",
    "convergence",
    "count_minima",
    "direction_panels",
    "doppler_panels",
    "gradient",
    "landscape",
    "panels",
    "png_bytes",
    "range_doppler",
    "scene",
    "spectrum",
    "turntable",
]
