"""Materials: what fraction of the incident power a surface sends where."""

from invertwin.scene.material.materials import (
    MIRROR_LOBE_WIDTH,
    ROUGH_LOBE_WIDTH,
    PerfectConductor,
    RoughDielectric,
    complex_permittivity,
    fresnel_amplitude,
    fresnel_reflectance,
    lobe_exponent,
    lobe_integral,
)
from invertwin.scene.material.surface import ANGLE_COUNT, Material, Surface

__all__ = [
    "ANGLE_COUNT",
    "MIRROR_LOBE_WIDTH",
    "ROUGH_LOBE_WIDTH",
    "Material",
    "PerfectConductor",
    "RoughDielectric",
    "Surface",
    "complex_permittivity",
    "fresnel_amplitude",
    "fresnel_reflectance",
    "lobe_exponent",
    "lobe_integral",
]
