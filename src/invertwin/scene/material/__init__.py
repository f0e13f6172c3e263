"""Materials: reflection, scattering and transmission of surfaces.

`surface` defines the inputs of the ray kernel; `materials` the user classes; `fresnel`, `slab` and
`roughness` their physics; `itu` the table of P.2040; `values` the types and ranges of material
values.
"""
