"""Propagation paths between antennas as responses, OFDM channels, spreads and radio maps."""

from invertwin.deprecation import rename_attributes
from invertwin.links.cells import CellSampling as CellSampling
from invertwin.links.cells import MapMesh as MapMesh
from invertwin.links.cells import MapPlane as MapPlane
from invertwin.links.conversion import ray_paths_from_sionna as ray_paths_from_sionna
from invertwin.links.listing import path_table as path_table
from invertwin.links.metasurface.panel import Metasurface as Metasurface
from invertwin.links.metasurface.panel import panel_paths as panel_paths
from invertwin.links.metasurface.panel import panel_response as panel_response
from invertwin.links.metasurface.wall_path import ElementPhases as ElementPhases
from invertwin.links.metasurface.wall_path import PanelPlacement as PanelPlacement
from invertwin.links.metasurface.wall_path import WallPath as WallPath
from invertwin.links.places import ReceiverLocations as ReceiverLocations
from invertwin.links.places import ReceiverPoints as ReceiverPoints
from invertwin.links.received import LinkStatistics as LinkStatistics
from invertwin.links.received import PropagationSettings as PropagationSettings
from invertwin.links.received import received_gain as received_gain
from invertwin.links.responses import AntennaMount as AntennaMount
from invertwin.links.responses import frequency_response as frequency_response
from invertwin.links.responses import impulse_response as impulse_response
from invertwin.links.responses import ofdm_channel as ofdm_channel
from invertwin.links.responses import path_amplitudes as path_amplitudes
from invertwin.links.reverberation import Reverberation as Reverberation
from invertwin.links.spreads import angle_spread as angle_spread
from invertwin.links.spreads import delay_spread as delay_spread
from invertwin.links.spreads import rician_factor as rician_factor
from invertwin.links.transmitters import ReverberationParameters as ReverberationParameters
from invertwin.links.transmitters import TransmitterPosition as TransmitterPosition
from invertwin.links.transmitters import Transmitters as Transmitters

rename_attributes(__name__)
