"""Slabs and multilayers against closed forms and a transmission line; energy; gradients."""

import cmath
import itertools
import math

import numpy as np
import pytest
import torch

from invertwin.constants import SPEED_OF_LIGHT, VACUUM_PERMITTIVITY
from invertwin.errors import InputError
from invertwin.scene import Itu, Layer, Multilayer, RoughDielectric, Slab, slab_coefficients
from invertwin.scene.material.slab import slab_tables
from oracles import transmission_line

NODES = np.linspace(0, 1, 256)
FREQUENCY = 77e9

MATERIALS = [(1.3, 0.0), (2.73, 0.05), (3.0, 2.0), (5.24, 0.3), (6.31, 1.2), (15.0, 10.0)]
THICKNESSES = [0.5e-3, 3.1e-3, 12.5e-3]
ANGLES = [3, 20, 45, 77, 110, 140, 170, 200, 230, 255]  # nodes of the table


def epsilon_of(permittivity, conductivity, frequency=FREQUENCY):
    return complex(permittivity, -conductivity / (2 * math.pi * frequency * VACUUM_PERMITTIVITY))


def airy(epsilon, thickness, cosine, polarisation):
    """Reflection and transmission of one slab, summed over its inner echoes in closed form."""
    root = cmath.sqrt(epsilon - 1 + cosine**2)
    delta = 2 * math.pi * FREQUENCY / SPEED_OF_LIGHT * thickness * root
    first = (
        (cosine - root) / (cosine + root)
        if polarisation == "s"
        else (epsilon * cosine - root) / (epsilon * cosine + root)
    )
    once = cmath.exp(-1j * delta)
    echo = 1 - first**2 * once**2
    return first * (1 - once**2) / echo, (1 - first**2) * once / echo


def transfer_matrix(layers, cosine, polarisation, frequency=FREQUENCY):
    """Reflection of tangential E (s) and H (p), and transmission: products of 2 × 2 matrices.

    Layers are (ε, μ, thickness). A matrix takes tangential E and H of one face to those of the
    other (Born and Wolf, section 1.6).
    """
    k, whole = 2 * math.pi * frequency / SPEED_OF_LIGHT, np.eye(2)
    for epsilon, mu, thickness in layers:
        root = cmath.sqrt(epsilon * mu - 1 + cosine**2)
        wave = root / mu if polarisation == "s" else root / epsilon
        delta = k * root * thickness
        row = [[cmath.cos(delta), 1j * cmath.sin(delta) / wave]]
        whole = whole @ np.array([*row, [1j * wave * cmath.sin(delta), cmath.cos(delta)]])
    first, second = whole @ np.array([1.0, cosine])
    return (cosine * first - second) / (cosine * first + second), 2 * cosine / (
        cosine * first + second
    )


def test_magnetic_stacks_equal_the_transfer_matrix():
    worst = 0.0
    one = [(3.0 - 0.1j, 2.0 - 0.5j, 1.3e-3)]
    three = [(4.0, 1.0, 0.7e-3), (1.0, 5.0 - 1j, 0.4e-3), (2.0 - 1j, 1.5, 2e-3)]
    for sizes in (one, three):
        layers = [
            Layer(e.real, loss_tangent=-e.imag / e.real, permeability=m.real,
                  magnetic_loss_tangent=-m.imag / m.real, thickness=d)
            for e, m, d in sizes
        ]  # fmt: skip
        cosine = torch.from_numpy(NODES)
        sheets = [layer.sheet(FREQUENCY) for layer in layers]
        got = slab_coefficients(sheets, cosine, FREQUENCY)
        for node, polarisation in itertools.product(ANGLES, "sp"):
            reflection, transmission = transfer_matrix(sizes, NODES[node], polarisation)
            found = (
                getattr(got, f"{name}_{polarisation}") for name in ("reflection", "transmission")
            )
            for value, expected in zip(found, (reflection, transmission), strict=True):
                worst = max(worst, abs(complex(value[node]) - expected))
    assert worst < 1e-10


def test_group_delay_of_a_magnetic_slab_is_that_of_its_index():
    """Matched, so that no echo inside adds to it: ε = μ = 2.5, at normal incidence."""
    slab = Slab(2.5, permeability=2.5, thickness=0.02)
    extra = float(slab.scattering_law(FREQUENCY).extra_length[-1])
    assert extra == pytest.approx(1.5 * 0.02, rel=1e-9)
    assert float(slab.scattering_law(FREQUENCY).transmittance[-1]) == pytest.approx(1.0)


def test_a_dallenbach_absorber_has_its_null():
    """A magnetic layer on metal whose input impedance √(μ/ε) tanh(jkd√(εμ)) is 1 at 10 GHz."""
    frequency, thickness, epsilon = 10e9, 2e-3, 12.0 - 0.3j
    depth = 2j * math.pi * frequency / SPEED_OF_LIGHT * thickness

    def mismatch(mu):
        return cmath.sqrt(mu / epsilon) * cmath.tanh(depth * cmath.sqrt(epsilon * mu)) - 1

    before, mu = 1.0 - 1.0j, 1.1 - 1.2j
    for _ in range(60):  # secant
        low, high = mismatch(before), mismatch(mu)
        if high == low:
            break
        before, mu = mu, mu - high * (mu - before) / (high - low)
    assert abs(mismatch(mu)) < 1e-9
    assert mu.real > 0 > mu.imag
    coat = Layer(
        epsilon.real, loss_tangent=-epsilon.imag / epsilon.real, permeability=mu.real,
        magnetic_loss_tangent=-mu.imag / mu.real, thickness=thickness,
    )  # fmt: skip
    wall = Multilayer([coat, Layer(1.0, 1e14, thickness=1e-3)])
    null, beside = (wall.scattering_law(f).amplitude[-1] for f in (frequency, 1.3 * frequency))
    assert float(null) < 1e-4
    assert float(beside) > 0.1
    plain = Multilayer([Layer(12.0, loss_tangent=0.025, thickness=thickness), wall.layers[1]])
    assert float(plain.scattering_law(frequency).amplitude[-1]) > 0.8


def layers_of(material, frequency=FREQUENCY):
    return [layer.sheet(frequency) for layer in material.layers]


def test_one_slab_equals_the_airy_formula_in_360_cases():
    cases, worst = 0, 0.0
    for (permittivity, conductivity), thickness in itertools.product(MATERIALS, THICKNESSES):
        slab = Slab(permittivity, conductivity, thickness=thickness)
        cosine = torch.from_numpy(NODES)
        got = slab_coefficients([slab.sheet(FREQUENCY)], cosine, FREQUENCY)
        surface = slab.scattering_law(FREQUENCY)
        for node in ANGLES:
            powers = []
            for polarisation in ("s", "p"):
                reflection, transmission = airy(
                    epsilon_of(permittivity, conductivity), thickness, NODES[node], polarisation
                )
                powers.append((abs(reflection) ** 2, abs(transmission) ** 2))
                worst = max(
                    worst,
                    abs(complex(getattr(got, f"reflection_{polarisation}")[node]) - reflection),
                    abs(complex(getattr(got, f"transmission_{polarisation}")[node]) - transmission),
                )
                cases += 1
            reflectance, transmittance = np.mean(powers, axis=0)
            worst = max(
                worst,
                abs(float(surface.amplitude[node]) - math.sqrt(reflectance)),
                abs(float(surface.transmittance[node]) - transmittance),
            )
    assert cases == 360
    assert worst < 2e-6


WALL = Multilayer(
    [
        Layer(2.73, 0.1, thickness=12.5e-3),
        Layer(1.05, loss_tangent=1e-3, thickness=40e-3),
        Layer(3.2, 0.4, loss_tangent=0.02, thickness=4e-3),
    ]
)


def line_at(frequency):
    """The layers of `WALL` in the oracle's terms."""
    return [
        (2.73 - 1j * 0.1 / (2 * math.pi * frequency * VACUUM_PERMITTIVITY), 12.5e-3),
        (1.05 * (1 - 1e-3j), 40e-3),
        (3.2 * (1 - 0.02j) - 1j * 0.4 / (2 * math.pi * frequency * VACUUM_PERMITTIVITY), 4e-3),
    ]


@pytest.mark.parametrize("polarisation", ["s", "p"])
def test_layers_equal_a_transmission_line_over_frequency(polarisation):
    cosines = torch.tensor([0.05, 0.3, 0.7, 1.0], dtype=torch.float64)
    for frequency in np.linspace(70e9, 84e9, 57):
        got = slab_coefficients(layers_of(WALL, float(frequency)), cosines, float(frequency))
        for k, cosine in enumerate(cosines.tolist()):
            reflection, transmission = transmission_line.coefficients(
                line_at(frequency), cosine, frequency, polarisation
            )
            assert complex(getattr(got, f"reflection_{polarisation}")[k]) == pytest.approx(
                reflection, abs=1e-10
            )
            assert complex(getattr(got, f"transmission_{polarisation}")[k]) == pytest.approx(
                transmission, abs=1e-10
            )


def mean_excess(layers_at, cosine, frequency):
    """The oracle's extra length of both polarisations, weighted by what each lets through."""
    powers, lengths = [], []
    for polarisation in ("s", "p"):
        layers = layers_at(frequency)
        powers.append(
            abs(transmission_line.coefficients(layers, cosine, frequency, polarisation)[1]) ** 2
        )
        lengths.append(transmission_line.excess_length(layers_at, cosine, frequency, polarisation))
    return np.average(lengths, weights=powers)


@pytest.mark.parametrize("node", [5, 60, 128, 200, 255])
def test_excess_is_the_group_delay_of_the_transmission_line(node):
    expected = mean_excess(line_at, NODES[node], FREQUENCY)
    got = float(WALL.scattering_law(FREQUENCY).extra_length[node])
    assert got == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_excess_of_a_table_material_includes_its_dispersion():
    def ground(frequency):
        ghz = frequency / 1e9
        loss = 0.15 * ghz**1.30 / (2 * math.pi * frequency * VACUUM_PERMITTIVITY)
        return [(complex(30 * ghz**-0.4, -loss), 5e-3)]

    slab = Slab.itu("wet_ground", thickness=5e-3)
    got = slab.scattering_law(5e9).extra_length[[40, 255]].tolist()
    for node, length in zip((40, 255), got, strict=True):
        assert length == pytest.approx(mean_excess(ground, NODES[node], 5e9), rel=1e-6)


def test_excess_of_a_faint_slab_is_the_extra_optical_path():
    # Hardly any reflection: what is left is d (√(ε − sin²θ) − cosθ).
    surface = Slab(1.0004, thickness=0.02).scattering_law(FREQUENCY)
    cosine = NODES[[100, 200, 255]]
    expected = 0.02 * (np.sqrt(0.0004 + cosine**2) - cosine)
    got = surface.extra_length[[100, 200, 255]].tolist()
    assert got == pytest.approx(expected.tolist(), rel=2e-3)


def test_the_phase_through_the_thickness_is_counted_once():
    # A quarter of a wavelength of air is no slab: its coefficient has the phase, nothing is added.
    quarter = SPEED_OF_LIGHT / FREQUENCY / 4
    air = Slab(1.0, thickness=quarter)
    one = torch.ones(1, dtype=torch.float64)
    got = slab_coefficients([air.sheet(FREQUENCY)], one, FREQUENCY)
    assert complex(got.transmission_s) == pytest.approx(-1j, abs=1e-12)
    assert air.scattering_law(FREQUENCY).extra_length.abs().max() < 1e-9
    assert (air.scattering_law(FREQUENCY).amplitude == 0).all()


@pytest.mark.parametrize("thickness", [1e-3, 7.3e-3, 50e-3])
@pytest.mark.parametrize("permittivity", [1.2, 2.73, 9.0])
def test_what_is_not_absorbed_is_reflected_or_transmitted(permittivity, thickness):
    surface = Slab(permittivity, thickness=thickness).scattering_law(FREQUENCY)
    total = surface.amplitude**2 + surface.transmittance
    assert (total - 1).abs().max() < 1e-9


@pytest.mark.parametrize("polarisation", ["s", "p"])
@pytest.mark.parametrize("cosine", [0.1, 0.4, 0.8, 1.0])
def test_reflected_transmitted_and_absorbed_power_add_up(polarisation, cosine):
    got = slab_coefficients(layers_of(WALL), torch.tensor([cosine], dtype=torch.float64), FREQUENCY)
    reflected = abs(complex(getattr(got, f"reflection_{polarisation}"))) ** 2
    transmitted = abs(complex(getattr(got, f"transmission_{polarisation}"))) ** 2
    heat = transmission_line.absorbed(line_at(FREQUENCY), cosine, FREQUENCY, polarisation)
    assert heat > 0.05
    assert reflected + transmitted + heat == pytest.approx(1, abs=1e-6)


def test_a_stack_transmits_the_same_from_both_sides():
    back = Multilayer(WALL.layers[::-1])
    front, behind = WALL.scattering_law(FREQUENCY), back.scattering_law(FREQUENCY)
    assert torch.allclose(front.transmittance, behind.transmittance, rtol=1e-10)
    assert torch.allclose(front.extra_length, behind.extra_length, rtol=1e-8)
    assert not torch.allclose(front.amplitude, behind.amplitude, rtol=1e-3)


def test_two_halves_make_the_whole():
    whole = Slab(4.0, 0.2, thickness=6e-3).scattering_law(FREQUENCY)
    halves = Multilayer([Layer(4.0, 0.2, thickness=3e-3)] * 2).scattering_law(FREQUENCY)
    for name in ("amplitude", "transmittance", "extra_length"):
        assert torch.allclose(getattr(whole, name), getattr(halves, name), atol=1e-12)


def test_a_thick_lossy_slab_is_a_half_space():
    # exp(+kd Im √ε) is far beyond the largest number here: only decaying exponentials are formed.
    surface = Slab(4.0, 1e4, thickness=10.0).scattering_law(FREQUENCY)
    expected = RoughDielectric(4.0, 1e4).scattering_law(FREQUENCY).amplitude
    assert torch.allclose(surface.amplitude, expected, atol=1e-9)
    assert (surface.transmittance == 0).all()
    assert torch.isfinite(surface.extra_length).all()


def tables(*values):
    slab = Multilayer(
        [
            Layer(values[0], values[1], loss_tangent=values[2], thickness=values[3]),
            Layer(values[4], values[5], loss_tangent=values[6], thickness=values[7]),
        ]
    )
    found = slab_tables(layers_of(slab), torch.from_numpy(NODES[5::25]), FREQUENCY)
    return tuple(found)


def test_gradients_in_every_value_of_every_layer():
    values = (2.7, 0.1, 0.01, 2.1e-3, 3.5, 0.5, 0.03, 1.3e-3)
    inputs = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in values]
    assert torch.autograd.gradcheck(tables, inputs, eps=1e-8, atol=1e-4, rtol=1e-4)


def test_forward_derivatives_agree_with_reverse_ones():
    values = (2.7, 0.1, 0.01, 2.1e-3, 3.5, 0.5, 0.03, 1.3e-3)
    inputs = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in values]
    check = torch.autograd.gradcheck
    assert check(
        tables,
        inputs,
        eps=1e-8,
        atol=1e-4,
        rtol=1e-4,
        check_forward_ad=True,
        check_backward_ad=False,
    )


@pytest.mark.parametrize(
    ("permittivity", "conductivity", "thickness"),
    [(1.0, 0.0, 0.0), (1.0, 0.0, 0.01), (4.0, 0.0, 0.0), (1.0, 1e7, 0.01), (4.0, 0.0, 1e3)],
)
def test_power_is_kept_at_the_ends(permittivity, conductivity, thickness):
    """Reflected and transmitted power without losses; as a half space where nothing passes."""
    values = [
        torch.tensor(v, dtype=torch.float64, requires_grad=True)
        for v in (permittivity, conductivity, thickness)
    ]
    surface = Slab(values[0], values[1], thickness=values[2]).scattering_law(FREQUENCY)
    for table in (surface.amplitude, surface.transmittance, surface.extra_length):
        gradients = torch.autograd.grad(table[1:].sum(), values, retain_graph=True)
        assert all(torch.isfinite(g) for g in gradients)
    reflected = surface.amplitude.square()
    if conductivity > 0:
        half_space = RoughDielectric(permittivity, conductivity).scattering_law(FREQUENCY)
        torch.testing.assert_close(surface.amplitude, half_space.amplitude)
        assert not surface.transmittance.any()
        return
    # Grazing waves, in the first row, pass only where there is nothing.
    power = (reflected + surface.transmittance)[1:]
    torch.testing.assert_close(power, torch.ones_like(power))
    changes = torch.autograd.grad(power.sum(), values[::2], retain_graph=True)
    scales = torch.autograd.grad(surface.transmittance[1:].sum(), values[::2], retain_graph=True)
    for change, scale in zip(changes, scales, strict=True):
        assert abs(float(change)) < 1e-6 * (1 + abs(float(scale)))
    if permittivity == 1 or thickness == 0:
        assert not reflected.any()
        assert surface.extra_length[1:].abs().max() < 1e-12


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Slab(0.5, thickness=0.01), r"relative permittivity in \[1, 1e\+15\], got 0.5"),
        (lambda: Slab(2.0, thickness=-0.01), r"thickness \[m\] in \[0, 1e\+15\], got -0.01"),
        (lambda: Layer(2.0, -1.0, thickness=0.01), "conductivity"),
        (lambda: Layer(2.0, loss_tangent=-1.0, thickness=0.01), "loss tangent"),
        (lambda: Layer(2.0, thickness=math.nan), "thickness"),
        (
            lambda: Slab(2.0, permeability=0.0, thickness=0.01),
            r"permeability in \(0, 1e\+15\], got 0",
        ),
        (lambda: Slab(2.0, magnetic_loss_tangent=-1.0, thickness=0.01), "magnetic loss tangent"),
        (lambda: Multilayer([]), "at least one Layer, got none"),
        (lambda: Multilayer([3.0]), "at least one Layer, got float"),  # pyright: ignore[reportArgumentType]
        (lambda: slab_coefficients([], torch.ones(1).double(), 1e9), "at least one layer"),
        (
            lambda: slab_coefficients([Layer(2.0, thickness=0.01)], torch.ones(1).double(), 1e9),  # pyright: ignore[reportArgumentType]
            r"layers at a frequency \(SlabLayer\), got Layer",
        ),
        (lambda: Slab(2.0, thickness=0.01).scattering_law(-1.0), "frequency"),
        (lambda: Slab(Itu("concrete"), thickness=Itu("concrete")), "thickness"),  # pyright: ignore[reportArgumentType]
    ],
)
def test_bad_slabs_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


@pytest.mark.parametrize(
    ("slab", "least", "most"),
    [
        (Slab.itu("plasterboard", thickness=12.5e-3), 1e-5, 1e-4),
        # Fringes finer than the table: docs/limitations.md says how far off it is.
        (Slab(1.05, loss_tangent=1e-4, thickness=0.1), 0.03, 0.08),
    ],
)
def test_tables_between_their_nodes(slab, least, most):
    cosine = np.linspace(0, 1, 5000)
    exact = slab_tables([slab.sheet(FREQUENCY)], torch.from_numpy(cosine), FREQUENCY)
    table = np.interp(cosine, NODES, slab.scattering_law(FREQUENCY).amplitude.numpy())
    error = np.abs(table - exact.reflectance.sqrt().numpy()).max()
    assert least < error < most
