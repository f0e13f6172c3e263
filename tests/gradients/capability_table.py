"""The capability table: for every parameter and mechanism, what a derivative does.

`test_capabilities.py` and `test_capabilities_bounces.py` check each cell; `benchmarks/results.py`
writes the table into docs/derivatives.md.
"""

#: Headings of the columns by the key that the tests use, in the order of the columns below.
MECHANISMS = {
    "interior": "power paths, interior",
    "boundary": "power paths, boundary",
    "bounces interior": "2+ bounces, interior",
    "bounces boundary": "2+ bounces, boundary",
    "coherent": "coherent field",
    "rough": "rough field",
    "signature": "RCS",
    "chains": "facet paths",
    "targets": "coherent targets",
    "antennas": "paths between antennas",
    "coverage": "coverage maps",
    "mirrored": "reflected scattering",
    "panels": "metasurfaces",
    "images": "images",
}

# S supported: agrees with converged central differences. 0 exactly zero, and so is the truth.
# R refused: raises an InputError that names it. - does not apply.
_WORDS = {"S": "supported", "0": "zero", "R": "refused", "-": "–"}
_TABLE = """
translation            S S S S S R S S S S S S S S
pose                   S S S S S R S S S S S S S S
scale                  S S S S S R S S S - S S S S
vertices               S S S S S R S S S S S S S S
radar position         S S S S S R - S S S S S S S
radar rotation         S 0 S 0 S R - S S - - - - S
permittivity           S 0 S 0 R S S R R S S S 0 0
conductivity           S 0 S 0 R S S R R S S S 0 0
diffuse fraction       S 0 S 0 R S - R R - - S 0 0
lobe width             S 0 S 0 0 S - 0 0 - - S 0 0
thickness              S 0 S 0 - S S - - S S S 0 0
roughness              S 0 S 0 - S 0 - - 0 0 S 0 0
scattering coefficient S 0 S 0 - S S - - S S S 0 0
depolarisation         S 0 S 0 R S 0 R R 0 0 S 0 0
density                S 0 - - R R R R 0 R R R R R
range bias             S 0 S 0 - - - - - - - - - -
clock offset           S S S S - - - - - - - - - -
reverberant tail       - - - - - - - - - - S - - -
object velocity        R R R R R R - R R S 0 R 0 0
antenna pattern        R R R R R R - R R - - - - -
antenna polarisation   R R R R R R - R R - - - - -
element positions      R R R R R R - R R - - - - -
"""


def _cells() -> dict[tuple[str, str], str]:
    found = {}
    for line in _TABLE.strip().splitlines():
        words = line.split()
        letters = words[-len(MECHANISMS) :]
        parameter = " ".join(words[: -len(MECHANISMS)])
        for mechanism, letter in zip(MECHANISMS, letters, strict=True):
            found[parameter, mechanism] = _WORDS[letter]
    return found


#: (parameter, mechanism) → supported, zero, refused or –.
CELLS = _cells()
