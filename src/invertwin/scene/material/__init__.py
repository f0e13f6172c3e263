"""Materials: what a surface reflects, scatters and lets through.

`surface` what the ray kernel is told; `materials` the classes that users build; `fresnel`, `slab`,
`roughness` their physics; `itu` the table of P.2040; `values` what a material value may be.
"""

from invertwin.scene.material.fresnel import FieldCoefficients as FieldCoefficients
from invertwin.scene.material.fresnel import complex_permittivity as complex_permittivity
from invertwin.scene.material.fresnel import fresnel_amplitude as fresnel_amplitude
from invertwin.scene.material.fresnel import fresnel_coefficients as fresnel_coefficients
from invertwin.scene.material.fresnel import fresnel_reflectance as fresnel_reflectance
from invertwin.scene.material.fresnel import fresnel_transmittance as fresnel_transmittance
from invertwin.scene.material.itu import ITU_MATERIALS as ITU_MATERIALS
from invertwin.scene.material.itu import Itu as Itu
from invertwin.scene.material.itu import OutsideTableWarning as OutsideTableWarning
from invertwin.scene.material.materials import Dielectric as Dielectric
from invertwin.scene.material.materials import Layer as Layer
from invertwin.scene.material.materials import Multilayer as Multilayer
from invertwin.scene.material.materials import PerfectConductor as PerfectConductor
from invertwin.scene.material.materials import RefractingBody as RefractingBody
from invertwin.scene.material.materials import RoughConductor as RoughConductor
from invertwin.scene.material.materials import RoughDielectric as RoughDielectric
from invertwin.scene.material.materials import Slab as Slab
from invertwin.scene.material.roughness import lobe_exponent as lobe_exponent
from invertwin.scene.material.roughness import lobe_integral as lobe_integral
from invertwin.scene.material.roughness import slope_exponent as slope_exponent
from invertwin.scene.material.slab import Sheet as Sheet
from invertwin.scene.material.slab import slab_coefficients as slab_coefficients
from invertwin.scene.material.slab import slab_tables as slab_tables
from invertwin.scene.material.surface import ANGLE_COUNT as ANGLE_COUNT
from invertwin.scene.material.surface import Material as Material
from invertwin.scene.material.surface import Surface as Surface
from invertwin.scene.material.values import RANGES as RANGES
from invertwin.scene.material.values import MaterialValue as MaterialValue
from invertwin.scene.material.values import Texture as Texture
from invertwin.scene.material.values import Value as Value
