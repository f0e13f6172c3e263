"""Three-dimensional displays: in a browser that answers, and on a page that stands alone."""

from invertwin.viewer.display import Body as Body
from invertwin.viewer.display import Display as Display
from invertwin.viewer.display import Layer as Layer
from invertwin.viewer.display import Maps as Maps
from invertwin.viewer.display import Step as Step
from invertwin.viewer.guard import Guard as Guard
from invertwin.viewer.layers import body_of as body_of
from invertwin.viewer.layers import capture_layers as capture_layers
from invertwin.viewer.layers import display_of as display_of
from invertwin.viewer.layers import ellipsoid_layers as ellipsoid_layers
from invertwin.viewer.layers import scene_layers as scene_layers
from invertwin.viewer.link import Link as Link
from invertwin.viewer.notebook import capture_html as capture_html
from invertwin.viewer.notebook import radar_html as radar_html
from invertwin.viewer.notebook import reconstruction_html as reconstruction_html
from invertwin.viewer.notebook import register_formatters as register_formatters
from invertwin.viewer.notebook import scene_html as scene_html
from invertwin.viewer.notebook import show as show
from invertwin.viewer.page import page_html as page_html
from invertwin.viewer.page import policy as policy
from invertwin.viewer.page import view_html as view_html
from invertwin.viewer.panels import MEASURED as MEASURED
from invertwin.viewer.panels import SIMULATED as SIMULATED
from invertwin.viewer.server import Viewer as Viewer
