"""Forward models, one file a kind of sensor."""

from invertwin.deprecation import rename_attributes
from invertwin.models.camera import DepthMap as DepthMap
from invertwin.models.camera import SilhouetteMap as SilhouetteMap
from invertwin.models.doppler import RangeDopplerMap as RangeDopplerMap
from invertwin.models.facets import FacetField as FacetField
from invertwin.models.facets import FacetMap as FacetMap
from invertwin.models.radar import BeatMap as BeatMap
from invertwin.models.radar import ExactMap as ExactMap
from invertwin.models.radar import SurrogateMap as SurrogateMap
from invertwin.models.radar import surrogate_correlation as surrogate_correlation
from invertwin.models.radio import QUANTITIES as QUANTITIES
from invertwin.models.radio import PanelMap as PanelMap
from invertwin.models.radio import RadioMap as RadioMap
from invertwin.models.radio import ResponseMap as ResponseMap
from invertwin.models.rcs import RcsMap as RcsMap
from invertwin.models.whitened import WhitenedMap as WhitenedMap

rename_attributes(__name__)
