"""Materials: what a surface reflects, scatters and lets through.

`surface` what the ray kernel is told; `materials` the classes that users build; `fresnel`, `slab`,
`roughness` their physics; `itu` the table of P.2040; `values` what a material value may be.
"""
