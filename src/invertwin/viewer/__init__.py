"""Three-dimensional displays: in a browser that answers, and on a page that stands alone."""

from invertwin.deprecation import rename_attributes
from invertwin.viewer.display import Display as Display
from invertwin.viewer.display import DisplayLayer as DisplayLayer
from invertwin.viewer.display import DisplayMaps as DisplayMaps
from invertwin.viewer.display import DisplayMesh as DisplayMesh
from invertwin.viewer.display import DisplayStep as DisplayStep
from invertwin.viewer.guard import AccessGuard as AccessGuard
from invertwin.viewer.layers import build_display as build_display
from invertwin.viewer.layers import capture_layers as capture_layers
from invertwin.viewer.layers import display_mesh as display_mesh
from invertwin.viewer.layers import ellipsoid_layers as ellipsoid_layers
from invertwin.viewer.layers import scene_layers as scene_layers
from invertwin.viewer.link import InteractiveSensor as InteractiveSensor
from invertwin.viewer.link_layers import link_layers as link_layers
from invertwin.viewer.notebook import capture_html as capture_html
from invertwin.viewer.notebook import radar_html as radar_html
from invertwin.viewer.notebook import reconstruction_html as reconstruction_html
from invertwin.viewer.notebook import scene_html as scene_html
from invertwin.viewer.notebook import show as show
from invertwin.viewer.page import content_security_policy as content_security_policy
from invertwin.viewer.page import page_html as page_html
from invertwin.viewer.page import view_html as view_html
from invertwin.viewer.panels import MEASURED as MEASURED
from invertwin.viewer.panels import SIMULATED as SIMULATED
from invertwin.viewer.server import Viewer as Viewer

rename_attributes(__name__)
