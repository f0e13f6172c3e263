"""Automatic reconstruction: objects in a recording with uncertainties, without an initial guess."""

from invertwin.deprecation import rename_attributes
from invertwin.discovery.clutter import Clutter as Clutter
from invertwin.discovery.clutter import choose_result as choose_result
from invertwin.discovery.clutter import estimate_clutter as estimate_clutter
from invertwin.discovery.clutter import finds_lobes as finds_lobes
from invertwin.discovery.clutter import needs_clutter as needs_clutter
from invertwin.discovery.clutter import needs_permittivities as needs_permittivities
from invertwin.discovery.clutter import reconstruct_among_clutter as reconstruct_among_clutter
from invertwin.discovery.clutter import (
    reconstruct_with_permittivities as reconstruct_with_permittivities,
)
from invertwin.discovery.movers import DetectedEcho as DetectedEcho
from invertwin.discovery.movers import MovingBody as MovingBody
from invertwin.discovery.movers import MovingTargetFit as MovingTargetFit
from invertwin.discovery.movers import MovingTargetMaps as MovingTargetMaps
from invertwin.discovery.movers import detect_strongest_target as detect_strongest_target
from invertwin.discovery.movers import point_response as point_response
from invertwin.discovery.outcome import DetectedObject as DetectedObject
from invertwin.discovery.outcome import GroundImage as GroundImage
from invertwin.discovery.outcome import ObjectTrack as ObjectTrack
from invertwin.discovery.outcome import Twin as Twin
from invertwin.discovery.recordings import average_chirps as average_chirps
from invertwin.discovery.recordings import twin as twin
from invertwin.discovery.shapes.primitives import SHAPE_KINDS as SHAPE_KINDS
from invertwin.discovery.shapes.primitives import PrimitiveModel as PrimitiveModel
from invertwin.discovery.shapes.primitives import ShapeParameters as ShapeParameters

rename_attributes(__name__)
