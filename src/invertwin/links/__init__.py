"""What paths between antennas add up to: responses, OFDM channels, spreads, radio maps."""

from invertwin.links.cells import CellSampling as CellSampling
from invertwin.links.cells import MapMesh as MapMesh
from invertwin.links.cells import MapPlane as MapPlane
from invertwin.links.conversion import ray_paths_of as ray_paths_of
from invertwin.links.listing import path_table as path_table
from invertwin.links.metasurface.panel import Metasurface as Metasurface
from invertwin.links.metasurface.panel import panel_paths as panel_paths
from invertwin.links.metasurface.panel import panel_response as panel_response
from invertwin.links.metasurface.wall_path import PlacedPanel as PlacedPanel
from invertwin.links.metasurface.wall_path import WallPath as WallPath
from invertwin.links.places import Places as Places
from invertwin.links.places import Points as Points
from invertwin.links.received import Received as Received
from invertwin.links.received import Reception as Reception
from invertwin.links.received import received_gain as received_gain
from invertwin.links.responses import Terminals as Terminals
from invertwin.links.responses import frequency_response as frequency_response
from invertwin.links.responses import impulse_response as impulse_response
from invertwin.links.responses import ofdm_channel as ofdm_channel
from invertwin.links.responses import path_amplitudes as path_amplitudes
from invertwin.links.spreads import angle_spread as angle_spread
from invertwin.links.spreads import delay_spread as delay_spread
from invertwin.links.spreads import rician_factor as rician_factor
from invertwin.links.transmitters import TransmitterPosition as TransmitterPosition
from invertwin.links.transmitters import Transmitters as Transmitters
