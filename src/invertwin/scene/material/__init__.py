"""Materials: what a surface reflects, scatters and lets through.

`surface` what the ray kernel is told; `materials` the classes that users build; `fresnel`, `slab`,
`roughness` their physics; `itu` the table of P.2040; `values` what a material value may be.
"""

from invertwin.scene.material.fresnel import (
    FieldCoefficients,
    complex_permittivity,
    fresnel_amplitude,
    fresnel_coefficients,
    fresnel_reflectance,
    fresnel_transmittance,
)
from invertwin.scene.material.itu import ITU_MATERIALS, Itu, OutsideTableWarning
from invertwin.scene.material.materials import (
    Dielectric,
    Layer,
    Multilayer,
    PerfectConductor,
    RefractingBody,
    RoughConductor,
    RoughDielectric,
    Slab,
)
from invertwin.scene.material.roughness import lobe_exponent, lobe_integral, slope_exponent
from invertwin.scene.material.slab import Sheet, slab_coefficients, slab_tables
from invertwin.scene.material.surface import ANGLE_COUNT, Material, Surface
from invertwin.scene.material.values import RANGES, Texture, Value

__all__ = [
    "ANGLE_COUNT",
    "ITU_MATERIALS",
    "RANGES",
    "Dielectric",
    "FieldCoefficients",
    "Itu",
    "Layer",
    "Material",
    "Multilayer",
    "OutsideTableWarning",
    "PerfectConductor",
    "RefractingBody",
    "RoughConductor",
    "RoughDielectric",
    "Sheet",
    "Slab",
    "Surface",
    "Texture",
    "Value",
    "complex_permittivity",
    "fresnel_amplitude",
    "fresnel_coefficients",
    "fresnel_reflectance",
    "fresnel_transmittance",
    "lobe_exponent",
    "lobe_integral",
    "slab_coefficients",
    "slab_tables",
    "slope_exponent",
]
