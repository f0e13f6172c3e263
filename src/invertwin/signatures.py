"""Radar signatures: complex 2 × 2 scattering matrices of a target over aspect and frequency.

The radar is in the far field. S is complex and polarised, σ = 4π|S|² is the radar cross-section.
Phases refer to the world's origin. Frequency sweeps give range profiles, sweeps of frequency and
aspect give images.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from invertwin import checks
from invertwin.channel import trace_far_field
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.deprecation import rename_attributes
from invertwin.errors import InputError
from invertwin.limits import Count, Positive
from invertwin.scene import Scene
from invertwin.scene.material.materials import Medium
from invertwin.scene.mesh_defects import require_single_surfaces
from invertwin.scene.polarisation import jones_basis

_VALUES_PER_CHUNK = 1 << 22  # frequencies × aspects × points
_SPACING_TOLERANCE = 1e-3  # relative difference of frequency steps, for float32 values


@dataclass(frozen=True, eq=False)
class Signature:
    """Scattering matrices S of a target over frequency and aspect.

    The first row and column of a matrix belong to the requested polarisation, the second to the
    orthogonal one: ``matrix[..., 0, 0]`` is co-polar, ``matrix[..., 1, 0]`` is cross-polar.

    Attributes:
        parts: S of each part of the field [m]: ``order 1``, ``order 2`` … are physical optics of
            that number of interactions with surfaces, faces of solids from inside included, ``edges
            1`` fringe currents, ``edges 2`` … multiple diffraction at edges of a plate, ``rest``
            the residual of these parts from the method of moments for small bodies.
        frequencies: frequencies [Hz].
        directions: unit vectors from the target to the transmitter.
        receivers: unit vectors from the target to the receiver.
    """

    parts: Mapping[str, Complex128[Tensor, "frequency aspect 2 2"]]
    frequencies: Float64[Tensor, " frequency"]
    directions: Float64[Tensor, "aspect 3"]
    receivers: Float64[Tensor, "aspect 3"]

    @property
    def matrix(self) -> Complex128[Tensor, "frequency aspect 2 2"]:
        """S of the total field [m], receive × transmit."""
        return torch.stack([*self.parts.values()]).sum(0)

    @property
    def cross_section(self) -> Float64[Tensor, "frequency aspect 2 2"]:
        """σ = 4π|S|² [m²]."""
        return 4 * math.pi * torch.view_as_real(self.matrix).square().sum(-1)

    @property
    def dbsm(self) -> Float64[Tensor, "frequency aspect 2 2"]:
        """σ = 4π|S|² over 1 m², in decibels."""
        return to_dbsm(self.matrix)

    def range_profile(
        self, padding: Count = 4
    ) -> tuple[Float64[Tensor, " range"], Complex128[Tensor, "range aspect 2 2"]]:
        """Compute the range profile: ranges from the origin [m], and amplitudes S there.

        A Hann window over the frequencies keeps sidelobes below −31 dB and preserves the S of a
        point. The bistatic range is half the path.

        Args:
            padding: oversampling factor over the resolution c/2B.

        Raises:
            InputError: fewer than two frequencies, or uneven ones.
        """
        count = len(self.frequencies)
        steps = self.frequencies.diff()
        if count < 2 or not bool(
            (steps > 0).all() & ((steps / steps[0] - 1).abs() < _SPACING_TOLERANCE).all()
        ):
            raise InputError(
                f"expected evenly spaced, ascending frequencies for a range profile, got {count}; "
                "give them as start, stop and count"
            )
        window = _hann_window(count)[:, None, None, None]
        length = count * checks.checked_count(padding, "padding", 1)
        profile = torch.fft.ifft(self.matrix * window, n=length, dim=0) * length / count
        spread = SPEED_OF_LIGHT / 2 / float(steps.mean())
        ranges = torch.fft.fftfreq(length, dtype=torch.float64) * spread
        order = torch.argsort(ranges)
        ranges = ranges[order]
        carrier = 4 * math.pi * float(self.frequencies[0]) / SPEED_OF_LIGHT * ranges
        carrier_phasor = torch.polar(torch.ones_like(carrier), carrier)
        return ranges, profile[order] * carrier_phasor[:, None, None, None]

    def image(self, points: checks.ArrayLike) -> Complex128[Tensor, "*grid 2 2"]:
        """Focus the sweep on points: the mean of S exp(−jk(u_t + u_r)·x), with Hann windows.

        Args:
            points: positions, [..., 3], in world axes [m]. Coarse sweeps alias outside the
                unambiguous range and cross range.
        """
        positions = torch.as_tensor(points, dtype=torch.float64)
        flat = positions.reshape(-1, 3)
        direction_sum = self.directions + self.receivers
        weight = (
            _hann_window(len(self.frequencies))[:, None]
            * _hann_window(len(direction_sum))
            / (len(self.frequencies) * len(direction_sum))
        )
        weighted = (self.matrix * weight[..., None, None]).reshape(-1, 4)
        k = 2 * math.pi * self.frequencies / SPEED_OF_LIGHT
        found = []
        for chunk in flat.split(max(1, _VALUES_PER_CHUNK // len(weighted))):
            phase = -(k[:, None, None] * (direction_sum @ chunk.T)).reshape(len(weighted), -1)
            found.append(torch.polar(torch.ones_like(phase), phase).T @ weighted)
        return torch.cat(found).reshape(*positions.shape[:-1], 2, 2)


def _require_dielectrics(scene: Scene) -> None:
    for name, item in scene.objects.items():
        if isinstance(item.material, Medium) and item.material.is_magnetic:
            raise InputError(
                f"expected a permeability of 1 of {name} for its cross-section, got a magnetic "
                "material; signatures know dielectrics only"
            )


def rcs(
    scene: Scene,
    directions: checks.ArrayLike,
    frequencies: float | Sequence[float] | Tensor,
    *,
    receivers: checks.ArrayLike | None = None,
    polarisation: str | Sequence[complex] = "V",
    depth: Count = 5,
    edges: int = 2,
    tubes_per_wavelength: Positive = 8.0,
    up: Sequence[float] = (0.0, 0.0, 1.0),
    boundary: bool = True,
) -> Signature:
    """Compute the radar cross-section of smooth conductors and dielectrics in the far field.

    Scenes of at most 24 triangles use beam tracing, exact physical optics of every bounce; others
    use shooting and bouncing rays. Closed dielectric bodies transmit, with internal bounces. Small
    conductors are solved by the method of moments, and ``rest`` is the residual of the rays. Scenes
    of at most 24 triangles are differentiable with respect to vertices, ``rest`` included.
    Monostatic and bistatic results are reciprocal.

    Args:
        scene: target near the world's origin.
        directions: vectors from the target to the radar or transmitter, [aspect, 3], of any length.
        frequencies: a frequency or several [Hz].
        receivers: vectors from the target to the receiver, [aspect, 3]; None = monostatic.
        polarisation: polarisation of the first row and column of the matrices: "V", "H", "circular"
            (right-hand) or a Jones vector (V, H). V and H are the unit vectors of θ and φ about
            ``up``.
        depth: maximum number of interactions with surfaces; the echo of a solid's back face needs
            three.
        edges: maximum number of diffractions at sharp edges of conductors: 0 is physical optics
            alone, 1 adds fringe currents, 2 the waves between the edges of a flat plate. From 1 on,
            small conductors are solved by the method of moments.
        tubes_per_wavelength: density of ray tubes at the highest frequency, for scenes of many
            triangles.
        up: vertical axis, [3].
        boundary: False omits the derivatives due to moving edges of beams and shadows: derivatives
            at fixed visibility, for ablation.

    Raises:
        InputError: no direction or frequency, a rough surface, a cloud, derivatives of a scene of
            more than 24 triangles or with respect to directions or frequencies, dielectrics in
            contact with or inside each other, a magnetic material, an object whose parts overlap
            or are doubled.

    Source: derivations §4, §13, §14.
    """
    transmitters, receiver_directions, sweep = _check_sweep(directions, receivers, frequencies)
    axis = checks.checked_tensor(up, (3,), "up", "give a vector such as 0, 0, 1")
    _require_dielectrics(scene)
    require_single_surfaces(scene)
    tubes = checks.checked_number(tubes_per_wavelength, "tubes per wavelength", 0.0, open_low=True)
    counts = checks.checked_count(depth, "depth", 1), checks.checked_count(edges, "edges", 0)
    how: dict[str, Any] = {"up": axis / axis.norm(), "boundary": boundary}
    how |= {"depth": counts[0], "edges": counts[1], "tubes_per_wavelength": tubes}
    parts = trace_far_field(scene, transmitters, receiver_directions, sweep, **how)
    basis = jones_basis(polarisation)
    rotated = {name: basis.T @ value @ basis for name, value in parts.items()}
    received = transmitters if receiver_directions is None else receiver_directions
    return Signature(rotated, sweep, transmitters, received)


def aspect_directions(
    theta: float | Sequence[float] | Tensor, phi: float | Sequence[float] | Tensor
) -> Float64[Tensor, "aspect 3"]:
    """Compute unit vectors at angles θ to z and φ from x towards y.

    Args:
        theta: polar angles θ [rad], a number or [aspect].
        phi: azimuth angles φ [rad], a number or [aspect].
    """
    t, p = torch.broadcast_tensors(
        *(torch.atleast_1d(torch.as_tensor(a, dtype=torch.float64)) for a in (theta, phi))
    )
    return torch.stack([t.sin() * p.cos(), t.sin() * p.sin(), t.cos()], 1)


def to_dbsm(amplitude: Complex128[Tensor, "*any"]) -> Float64[Tensor, "*any"]:
    """Compute σ = 4π|S|² in dBsm.

    Args:
        amplitude: scattering amplitudes S [m].
    """
    return 10 * torch.log10((4 * math.pi * amplitude.abs() ** 2).clamp_min(1e-300))


def _check_sweep(
    directions: checks.ArrayLike,
    receivers: checks.ArrayLike | None,
    frequencies: float | Sequence[float] | Tensor,
) -> tuple[Tensor, Tensor | None, Tensor]:
    """Check directions and frequencies; returns them as tensors, directions of unit length."""
    transmitters = _check_directions(directions, "directions")
    receiver_directions = None if receivers is None else _check_directions(receivers, "receivers")
    if receiver_directions is not None and len(receiver_directions) != len(transmitters):
        raise InputError(
            f"expected {len(transmitters)} receivers, one for each direction, got "
            f"{len(receiver_directions)}"
        )
    sweep = checks.checked_tensor(
        torch.atleast_1d(torch.as_tensor(frequencies, dtype=torch.float64)),
        (None,),
        "frequencies [Hz]",
        "give one or more",
    )
    for frequency in sweep.tolist():
        checks.checked_number(frequency, "frequency [Hz]", 0.0, open_low=True)
    for value, what in (
        (transmitters, "directions"),
        (receiver_directions, "receivers"),
        (sweep, "frequencies"),
    ):
        checks.refuse_derivatives(value, what, "turn the scene instead, or detach them")
    return transmitters, receiver_directions, sweep


def _check_directions(values: checks.ArrayLike, what: str) -> Tensor:
    do = "give x, y, z of each, towards the radar"
    found = checks.checked_tensor(values, (None, 3), what, do)
    length = found.norm(dim=1, keepdim=True)
    if not len(found) or not bool((length > 0).all()):
        raise InputError(f"expected {what} of some length, got {len(found)}; give x, y, z of each")
    return found / length


def _hann_window(count: int) -> Tensor:
    """Hann window of mean one, without zeros at its ends, so that short sweeps keep their ends."""
    window = torch.hann_window(count + 2, periodic=False, dtype=torch.float64)[1:-1]
    return window / window.mean()


rename_attributes(__name__)
