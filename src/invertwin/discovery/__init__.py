"""From a recording to a twin, with no start: which things there are, and how sure that is."""

from invertwin.discovery.movers import MoverMaps as MoverMaps
from invertwin.discovery.movers import MoverTwin as MoverTwin
from invertwin.discovery.movers import of_point as of_point
from invertwin.discovery.movers import strongest_mover as strongest_mover
from invertwin.discovery.moving_body import Echo as Echo
from invertwin.discovery.moving_body import MovingBody as MovingBody
from invertwin.discovery.outcome import Picture as Picture
from invertwin.discovery.outcome import Thing as Thing
from invertwin.discovery.outcome import Track as Track
from invertwin.discovery.outcome import Twin as Twin
from invertwin.discovery.recordings import still_capture as still_capture
from invertwin.discovery.recordings import twin as twin
from invertwin.discovery.shapes.primitives import KINDS as KINDS
from invertwin.discovery.shapes.primitives import Figure as Figure
from invertwin.discovery.shapes.primitives import Primitive as Primitive
