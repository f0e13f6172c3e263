"""Slabs as cascaded transmission lines: ABCD matrices of total fields, in NumPy.

Written apart from the library: tangential fields instead of waves, no reflection coefficients but
the last. `polarisation` is "s" (V = E across the plane of incidence) or "p" (V = E along it).
"""

import numpy as np

SPEED_OF_LIGHT = 299_792_458.0


def _line(epsilon, cosine, frequency, polarisation):
    """Propagation constant [1/m] and impedance over that of vacuum."""
    root = np.sqrt(complex(epsilon) - (1 - cosine**2))
    impedance = 1 / root if polarisation == "s" else root / epsilon
    return 2j * np.pi * frequency / SPEED_OF_LIGHT * root, impedance


def _transfer(epsilon, length, cosine, frequency, polarisation):
    gamma, impedance = _line(epsilon, cosine, frequency, polarisation)
    across, along = np.sinh(gamma * length), np.cosh(gamma * length)
    return np.array([[along, impedance * across], [across / impedance, along]])


def coefficients(layers, cosine, frequency, polarisation):
    """Reflection of E (its sign as Fresnel's) and transmission from face to face.

    Args:
        layers: (complex permittivity, thickness [m]) from the side of incidence on.
    """
    total = np.eye(2, dtype=complex)
    for epsilon, thickness in layers:
        total = total @ _transfer(epsilon, thickness, cosine, frequency, polarisation)
    (a, b), (c, d) = total
    air = _line(1.0, cosine, frequency, polarisation)[1]
    load = a + b / air + c * air + d
    reflection = (a + b / air - c * air - d) / load
    return (reflection if polarisation == "s" else -reflection), 2 / load


def absorbed(layers, cosine, frequency, polarisation, points=400):
    """Share of the incident power turned to heat: ∫ k ε'' |E|² dz / cosθ, layer by layer."""
    wave_number = 2 * np.pi * frequency / SPEED_OF_LIGHT
    nodes, weights = np.polynomial.legendre.leggauss(points)
    air = _line(1.0, cosine, frequency, polarisation)[1]
    incident = 1.0 if polarisation == "s" else cosine  # of V, for |E| = 1
    out = incident * coefficients(layers, cosine, frequency, polarisation)[1]
    state, total = np.array([out, out / air]), 0.0
    for epsilon, thickness in reversed(layers):
        density = []
        for depth in thickness * (nodes + 1) / 2:  # before the layer's far face
            matrix = _transfer(epsilon, depth, cosine, frequency, polarisation)
            voltage, current = matrix @ state
            across = 0.0
            if polarisation == "p":
                across = abs(np.sqrt(1 - cosine**2) * current / epsilon) ** 2
            density.append(abs(voltage) ** 2 + across)
        integral = thickness / 2 * (weights @ np.array(density))
        total += wave_number * -complex(epsilon).imag * integral / cosine
        state = _transfer(epsilon, thickness, cosine, frequency, polarisation) @ state
    return total


def excess_length(layers_at, cosine, frequency, polarisation, step=1e-6):
    """Group delay of the layers over that of as much air, times c₀, by differences in frequency.

    Args:
        layers_at: the layers at a frequency, so that materials may depend on it.
        step: relative.
    """
    high, low = (
        coefficients(layers_at(f), cosine, f, polarisation)[1]
        for f in (frequency * (1 + step), frequency * (1 - step))
    )
    slope = np.angle(high / low) / (2 * step * 2 * np.pi * frequency)
    thickness = sum(d for _, d in layers_at(frequency))
    return -SPEED_OF_LIGHT * slope - thickness * cosine
