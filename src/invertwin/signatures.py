"""Radar signatures: what a target returns over aspect and frequency, as complex 2 × 2 matrices.

The radar is far away. S is complex and polarised, σ = 4π|S|² is the radar cross-section. Phases
refer to the world's origin. From sweeps of frequency come range profiles, from sweeps of frequency
and aspect images.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from invertwin.channel import trace_far_field
from invertwin.checks import (
    ArrayLike,
    checked_count,
    checked_number,
    checked_tensor,
    is_differentiated,
)
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.limits import Count, Positive
from invertwin.scene import Scene
from invertwin.scene.polarisation import jones_basis

_VALUES_PER_CHUNK = 1 << 22  # frequencies × aspects × points
_SPACING_TOLERANCE = (
    1e-3  # of a step, by which steps of frequencies may differ: those of float32 do
)


@dataclass(frozen=True, eq=False)
class Signature:
    """What a target returns: S of every frequency and aspect.

    The first row and column of a matrix is the polarisation that was asked for, the second the
    one orthogonal to it: ``matrix[..., 0, 0]`` is co-polar, ``matrix[..., 1, 0]`` is cross-polar.

    Attributes:
        parts: S [m] of each part of the field: ``order 1``, ``order 2`` … are physical optics after
            as many meetings with surfaces, faces of solids from within included, ``edges 1`` fringe
            currents, ``edges 2`` … waves that several edges of a plate diffract, ``rest`` what
            these leave out of the solved field of small bodies.
        frequencies: [Hz].
        directions: unit vectors from the target to the transmitter.
        receivers: unit vectors to the receiver.
    """

    parts: Mapping[str, Complex128[Tensor, "frequency aspect 2 2"]]
    frequencies: Float64[Tensor, " frequency"]
    directions: Float64[Tensor, "aspect 3"]
    receivers: Float64[Tensor, "aspect 3"]

    @property
    def matrix(self) -> Complex128[Tensor, "frequency aspect 2 2"]:
        """S of the whole field [m], receive × transmit."""
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
        """Ranges beyond the origin [m], and the profile: the amplitude S of what is there.

        A Hann window over the frequencies keeps sidelobes below −31 dB; a point keeps its S. The
        range of two antennas is half the path.

        Args:
            padding: how many times finer than the resolution c/2B the profile is.

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
        length = count * checked_count(padding, "padding", 1)
        profile = torch.fft.ifft(self.matrix * window, n=length, dim=0) * length / count
        spread = SPEED_OF_LIGHT / 2 / float(steps.mean())
        ranges = torch.fft.fftfreq(length, dtype=torch.float64) * spread
        order = torch.argsort(ranges)
        ranges = ranges[order]
        carrier = 4 * math.pi * float(self.frequencies[0]) / SPEED_OF_LIGHT * ranges
        turn = torch.polar(torch.ones_like(carrier), carrier)
        return ranges, profile[order] * turn[:, None, None, None]

    def image(self, points: ArrayLike) -> Complex128[Tensor, "*grid 2 2"]:
        """Focus the sweep on points: the mean of S exp(−jk(u_t + u_r)·x), Hann windows over both.

        Args:
            points: places [..., 3] in the world [m]. Points further apart than the sweep resolves,
                c/2B in range and λ/2 over its angle across, alias where it is coarse.
        """
        places = torch.as_tensor(points, dtype=torch.float64)
        flat = places.reshape(-1, 3)
        both = self.directions + self.receivers
        weight = (
            _hann_window(len(self.frequencies))[:, None]
            * _hann_window(len(both))
            / (len(self.frequencies) * len(both))
        )
        weighted = (self.matrix * weight[..., None, None]).reshape(-1, 4)
        k = 2 * math.pi * self.frequencies / SPEED_OF_LIGHT
        found = []
        for some in flat.split(max(1, _VALUES_PER_CHUNK // len(weighted))):
            phase = -(k[:, None, None] * (both @ some.T)).reshape(len(weighted), -1)
            found.append(torch.polar(torch.ones_like(phase), phase).T @ weighted)
        return torch.cat(found).reshape(*places.shape[:-1], 2, 2)


def rcs(
    scene: Scene,
    directions: ArrayLike,
    frequencies: float | Sequence[float] | Tensor,
    *,
    receivers: ArrayLike | None = None,
    polarisation: str | Sequence[complex] = "V",
    depth: Count = 5,
    edges: int = 2,
    tubes_per_wavelength: Positive = 8.0,
    up: Sequence[float] = (0.0, 0.0, 1.0),
    boundary: bool = True,
) -> Signature:
    """Compute the radar cross-section of smooth conductors and dielectrics, far away.

    Scenes of at most 24 triangles are exact physical optics of every bounce; others are shot with
    ray tubes. Waves go through closed bodies of dielectric, with bounces inside. Of small
    conductors, currents are solved, and ``rest`` is what rays leave out. Scenes of at most 24
    triangles are differentiable with respect to vertices, ``rest`` included.
    Monostatic and bistatic results are reciprocal.

    Args:
        scene: the target about the world's origin.
        directions: from the target to the radar, or the transmitter: [aspect, 3], of any length.
        frequencies: [Hz].
        receivers: the same to the receiver, one for each direction; None = the transmitter.
        polarisation: of the first row and column of the matrices: "V", "H", "circular" (right-hand)
            or a Jones vector (V, H). V and H are the unit vectors of θ and φ about ``up``.
        depth: most meetings with surfaces; the echo of a solid's back face leaves by the third.
        edges: most diffractions of a wave by sharp edges of conductors: 0 is physical optics alone,
            1 adds fringe currents, 2 the waves between the edges of a flat plate. From 1 on small
            conductors are solved.
        tubes_per_wavelength: at the highest frequency, for scenes of many triangles.
        up: vertical axis.
        boundary: False leaves out of derivatives what moving edges of beams and shadows change:
            derivatives at fixed visibility, for ablation.

    Raises:
        InputError: no direction or frequency, a rough surface, a cloud, derivatives of a scene of
            more than 24 triangles or with respect to directions or frequencies, dielectrics that
            touch or lie in each other.

    Source: derivations §4, §13, §14.
    """
    sent = _check_directions(directions, "directions")
    received = None if receivers is None else _check_directions(receivers, "receivers")
    if received is not None and len(received) != len(sent):
        raise InputError(
            f"expected {len(sent)} receivers, one for each direction, got {len(received)}"
        )
    swept = checked_tensor(
        torch.atleast_1d(torch.as_tensor(frequencies, dtype=torch.float64)),
        (None,),
        "frequencies [Hz]",
        "give one or more",
    )
    for frequency in swept.tolist():
        checked_number(frequency, "frequency [Hz]", 0.0, open_low=True)
    for value, what in ((sent, "directions"), (received, "receivers"), (swept, "frequencies")):
        if is_differentiated(value):
            raise InputError(
                f"expected {what} without derivatives, got some that require grad; turn the scene "
                "instead, or detach them"
            )
    axis = checked_tensor(up, (3,), "up", "give a vector such as 0, 0, 1")
    parts = trace_far_field(
        scene,
        sent,
        received,
        swept,
        depth=checked_count(depth, "depth", 1),
        edges=checked_count(edges, "edges", 0),
        tubes_per_wavelength=checked_number(
            tubes_per_wavelength, "tubes per wavelength", 0.0, open_low=True
        ),
        up=axis / axis.norm(),
        boundary=boundary,
    )
    basis = jones_basis(polarisation)
    turned = {name: basis.T @ value @ basis for name, value in parts.items()}
    return Signature(turned, swept, sent, sent if received is None else received)


def aspect_directions(
    theta: float | Sequence[float] | Tensor, phi: float | Sequence[float] | Tensor
) -> Float64[Tensor, "aspect 3"]:
    """Unit vectors at angles θ to z and φ from x towards y [rad]; one may be a single number.

    Args:
        theta: one or several.
        phi: one or as many.
    """
    t, p = torch.broadcast_tensors(
        *(torch.atleast_1d(torch.as_tensor(a, dtype=torch.float64)) for a in (theta, phi))
    )
    return torch.stack([t.sin() * p.cos(), t.sin() * p.sin(), t.cos()], 1)


def to_dbsm(amplitude: Complex128[Tensor, "*any"]) -> Float64[Tensor, "*any"]:
    """σ = 4π|S|² in dBsm.

    Args:
        amplitude: S [m].
    """
    return 10 * torch.log10((4 * math.pi * amplitude.abs() ** 2).clamp_min(1e-300))


def _check_directions(values: ArrayLike, what: str) -> Tensor:
    found = checked_tensor(values, (None, 3), what, "give x, y, z of each, towards the radar")
    length = found.norm(dim=1, keepdim=True)
    if not len(found) or not bool((length > 0).all()):
        raise InputError(f"expected {what} of some length, got {len(found)}; give x, y, z of each")
    return found / length


def _hann_window(count: int) -> Tensor:
    """A Hann window of mean one; without zeros at its ends, so that short sweeps keep theirs."""
    window = torch.hann_window(count + 2, periodic=False, dtype=torch.float64)[1:-1]
    return window / window.mean()
