"""From a scene to propagation paths: the only package that calls the ray tracer."""

from invertwin.channel.beams.coherent_targets import as_absorbers as as_absorbers
from invertwin.channel.beams.coherent_targets import combine_coherently as combine_coherently
from invertwin.channel.beams.coherent_targets import trace_target as trace_target
from invertwin.channel.beams.facet_paths import trace_facet_paths as trace_facet_paths
from invertwin.channel.beams.partial_visibility import PanelCells as PanelCells
from invertwin.channel.beams.partial_visibility import visible_fractions as visible_fractions
from invertwin.channel.coherent.field import trace_field as trace_field
from invertwin.channel.coherent.power_paths import trace_power as trace_power
from invertwin.channel.coherent.speckle import Speckle as Speckle
from invertwin.channel.coherent.speckle import draw_speckle as draw_speckle
from invertwin.channel.coverage.coverage import PathMeasure as PathMeasure
from invertwin.channel.coverage.coverage import trace_coverage as trace_coverage
from invertwin.channel.coverage.mirrors import deposit_mirrored_power as deposit_mirrored_power
from invertwin.channel.coverage.mirrors import trace_field_with_mirrors as trace_field_with_mirrors
from invertwin.channel.coverage.mirrors import trace_mirrored_power as trace_mirrored_power
from invertwin.channel.coverage.single_scattering import scattered_power as scattered_power
from invertwin.channel.coverage.single_scattering import (
    trace_single_scattering as trace_single_scattering,
)
from invertwin.channel.coverage.single_scattering import without_specular as without_specular
from invertwin.channel.em.plane_waves import polarisations as polarisations
from invertwin.channel.paths import GainPattern as GainPattern
from invertwin.channel.paths import Grid as Grid
from invertwin.channel.paths import Link as Link
from invertwin.channel.paths import Paths as Paths
from invertwin.channel.power.bins import deposit_paths as deposit_paths
from invertwin.channel.power.clouds import deposit_density as deposit_density
from invertwin.channel.power.deposit import deposit_batch as deposit_batch
from invertwin.channel.power.deposit import deposit_power as deposit_power
from invertwin.channel.rays.backend import backend as backend
from invertwin.channel.rays.backend import use_backend as use_backend
from invertwin.channel.rays.ray_scene import visible_points as visible_points
from invertwin.channel.rays.visibility import DiscontinuityCurves as DiscontinuityCurves
from invertwin.channel.rays.visibility import ViewpointScene as ViewpointScene
from invertwin.channel.rcs.closed_forms import CrossSection as CrossSection
from invertwin.channel.rcs.closed_forms import DihedralSection as DihedralSection
from invertwin.channel.rcs.closed_forms import PlateSection as PlateSection
from invertwin.channel.rcs.closed_forms import SphereSection as SphereSection
from invertwin.channel.rcs.closed_forms import SquareTrihedralSection as SquareTrihedralSection
from invertwin.channel.rcs.closed_forms import TrihedralSection as TrihedralSection
from invertwin.channel.rcs.far_field import trace_far_field as trace_far_field
from invertwin.channel.sampling import Densities as Densities
from invertwin.channel.sampling import Sampling as Sampling
from invertwin.channel.specular.point_targets import trace_point_targets as trace_point_targets
from invertwin.channel.specular.ray_paths import KINDS as KINDS
from invertwin.channel.specular.ray_paths import METASURFACE as METASURFACE
from invertwin.channel.specular.ray_paths import RayPaths as RayPaths
from invertwin.channel.specular.trace_paths import trace_paths as trace_paths
from invertwin.deprecation import rename_attributes

rename_attributes(__name__)
