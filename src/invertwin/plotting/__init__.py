"""Matplotlib figures of what the package computes: maps, scenes, fits.

Every function returns a `matplotlib.figure.Figure`, drawn without pyplot, so that nothing global
changes: save it with ``figure.savefig(path)`` or show it in a notebook. The turntable is an
animation and comes as the bytes of a GIF.
"""

from invertwin.deprecation import rename_attributes
from invertwin.plotting.coverage import coverage as coverage
from invertwin.plotting.curves import convergence as convergence
from invertwin.plotting.curves import count_minima as count_minima
from invertwin.plotting.curves import landscape as landscape
from invertwin.plotting.curves import rcs_curves as rcs_curves
from invertwin.plotting.curves import rcs_derivatives as rcs_derivatives
from invertwin.plotting.curves import rcs_image as rcs_image
from invertwin.plotting.curves import rcs_profile as rcs_profile
from invertwin.plotting.figures import PALETTE as PALETTE
from invertwin.plotting.figures import png_bytes as png_bytes
from invertwin.plotting.from_above import from_above as from_above
from invertwin.plotting.maps import RATE_LABEL as RATE_LABEL
from invertwin.plotting.maps import U_LABEL as U_LABEL
from invertwin.plotting.maps import V_LABEL as V_LABEL
from invertwin.plotting.maps import MapPanel as MapPanel
from invertwin.plotting.maps import direction_panels as direction_panels
from invertwin.plotting.maps import doppler_panels as doppler_panels
from invertwin.plotting.maps import gradient as gradient
from invertwin.plotting.maps import images as images
from invertwin.plotting.maps import panels as panels
from invertwin.plotting.maps import range_doppler as range_doppler
from invertwin.plotting.maps import residuals as residuals
from invertwin.plotting.maps import spectrogram as spectrogram
from invertwin.plotting.maps import spectrum as spectrum
from invertwin.plotting.rooms import floor_plan as floor_plan
from invertwin.plotting.rooms import placements as placements
from invertwin.plotting.rooms import transmitter_fits as transmitter_fits
from invertwin.plotting.scenes import scene as scene
from invertwin.plotting.scenes import turntable as turntable

rename_attributes(__name__)
