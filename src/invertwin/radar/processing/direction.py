"""Super-resolution directions: Capon and MUSIC, differentiable with respect to the signal."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Complex, Complex128, Float, Float64, Int64
from torch import Tensor

from invertwin.channel import Grid
from invertwin.checks import check_choice, check_shape, checked_number
from invertwin.errors import InputError
from invertwin.radar.aperture import Aperture, aperture
from invertwin.radar.radar import Radar

# Gaps between signal and noise eigenvalues below this fraction of the largest one are rounding
# errors: there the derivative of the subspace is damped.
_SMALLEST_GAP = 1e-8
# Tolerance of a uniform spacing, relative to it.
_UNIFORMITY = 0.02
_Subarray = tuple[int, int] | None  # elements along y and z; None = the whole array
_Matrices = Complex128[Tensor, "*batch element element"]  # covariances


@dataclass(frozen=True, eq=False)
class _Snapshots:
    """Snapshots of a (sub)array and its element positions.

    Attributes:
        values: snapshots [snapshot, element].
        array: The whole virtual array.
        y, z: Positions of the elements in the radar frame [m].
    """

    values: Complex128[Tensor, "frame range snapshot element"]
    array: Aperture
    y: Float64[Tensor, " element"]
    z: Float64[Tensor, " element"]

    def manifold(self, grid: Grid) -> Complex128[Tensor, "direction element"]:
        """Return beat phases across the array of a source in each direction: exp(−jk(uy + vz))."""
        return self.array.beams(grid.u, grid.v, self.y, self.z).conj().to(self.values.device)

    def covariance(self) -> Complex128[Tensor, "frame range element element"]:
        """Return the mean of x xᴴ over the snapshots."""
        return self.values.mT @ self.values.conj() / self.values.shape[-2]


def capon(
    profile: Complex[Tensor, "frame snapshot tx rx range"],
    radar: Radar,
    grid: Grid,
    *,
    loading: float = 1e-2,
    smoothing: _Subarray = None,
    forward_backward: bool = False,
) -> Float64[Tensor, "frame range u v"]:
    """Compute the Capon (minimum variance) power spectrum: 1 / aᴴ (R + δI)⁻¹ a.

    A single point target of |a|² peaks at |a|² (1 + δ/elements) plus noise. The result is
    differentiable with respect to the profile.

    Args:
        profile: range profiles; snapshots are chirps, or one snapshot per Doppler bin with the bins
            as frames: for moving targets under time-division multiplexing, after
            ``compensate_tdm``.
        radar: radar with its array, without window; its poses are unused.
        grid: grid with its directions.
        loading: Diagonal loading δ in units of the mean power of an element.
        smoothing: elements of the subarrays along y and z over whose shifts the covariance is
            averaged (spatial smoothing, which decorrelates coherent targets); None = none.
        forward_backward: whether to average with the reversed array, which doubles the snapshots.

    Raises:
        InputError: The profile does not fit radar or grid, an axis of the array that the grid
            does not resolve, a loading that is not positive, smoothing or forward_backward on an
            array that is not a uniform rectangle of elements, or subarrays larger than it.
    """
    checked_number(loading, "loading [mean power]", 0.0, open_low=True)
    snapshots = _snapshots(profile, radar, grid, smoothing, forward_backward)
    covariance = snapshots.covariance()
    level = covariance.diagonal(dim1=-2, dim2=-1).real.mean(-1)
    identity = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
    # Empty bins have no scale; any finite value results in power zero.
    loaded = covariance / torch.where(level > 0, level, 1.0)[..., None, None] + loading * identity
    manifold = snapshots.manifold(grid)
    waves, root = manifold.mT.expand(*level.shape, -1, -1), torch.linalg.cholesky(loaded)
    whitened = torch.linalg.solve_triangular(root, waves, upper=False)
    power = level[..., None] / whitened.abs().square().sum(-2)
    return power.unflatten(-1, (grid.u_count, grid.v_count))


def music(
    profile: Complex[Tensor, "frame snapshot tx rx range"],
    radar: Radar,
    grid: Grid,
    *,
    sources: int | str = "mdl",
    smoothing: _Subarray = None,
    forward_backward: bool = False,
) -> Float64[Tensor, "frame range u v"]:
    """Compute the MUSIC pseudospectrum: elements / aᴴ E Eᴴ a, with E the noise subspace; at least
    1.

    It is differentiable with respect to the profile. The derivative of the projector on the noise
    subspace depends on the gap between signal and noise eigenvalues only. It is finite for equal
    eigenvalues within either set, and damped where the gap vanishes and the subspace is
    discontinuous.

    Args:
        profile: range profiles; snapshots are chirps or Doppler bins, see ``capon``.
        radar: radar with its array, without window; its poses are unused.
        grid: grid with its directions.
        sources: number of sources in every bin, or the criterion that estimates it: ``mdl`` or
            ``aic``.
        smoothing: Elements of the subarrays along y and z; None = no smoothing, see ``capon``.
        forward_backward: whether to average with the reversed array, which doubles the snapshots.

    Raises:
        InputError: As for ``capon``; an unknown criterion; more sources than elements minus one or
            than snapshots allow.
    """
    snapshots = _snapshots(profile, radar, grid, smoothing, forward_backward)
    covariance = snapshots.covariance()
    elements = covariance.shape[-1]
    if isinstance(sources, str):
        values = torch.linalg.eigvalsh(covariance.detach())
        count = source_count(values, snapshots.values.shape[-2], sources)
    else:
        seen = snapshots.values.shape[-2]
        if not 0 <= sources <= min(elements - 1, seen):
            raise InputError(
                f"expected 0 to {elements - 1} sources, fewer than the {elements} elements of a "
                f"(sub)array, and at most {seen} sources from as many snapshots, got {sources}; "
                "give more chirps or other smoothing"
            )
        count = torch.full(covariance.shape[:2], sources, device=covariance.device)
    # Eigenvalues ascend: those of the signal are last.
    signal = torch.arange(elements, device=covariance.device) >= elements - count[..., None]
    projector = _SignalProjector.apply(covariance, signal)
    manifold = snapshots.manifold(grid)
    inside = torch.einsum("dm,frmn,dn->frd", manifold.conj(), projector, manifold).real
    # Without noise the remainder of a source is rounding error.
    outside = (1 - inside / elements).clamp(min=1e-15)
    return (1 / outside).unflatten(-1, (grid.u_count, grid.v_count))


def source_count(
    eigenvalues: Float[Tensor, "*batch element"], snapshots: int, rule: str = "mdl"
) -> Int64[Tensor, "*batch"]:
    """Estimate the number of sources from the eigenvalues of a covariance matrix.

    Minimises −N (M − k) log(geometric/arithmetic mean of the M − k smallest) plus, with
    d = k (2M − k), d for ``aic`` or d log(N)/2 for ``mdl``, over k = 0 … M − 1.

    Source: Wax and Kailath, Detection of signals by information theoretic criteria, 1985.

    Args:
        eigenvalues: M eigenvalues in any order.
        snapshots: number N of independent snapshots.
        rule: ``mdl`` (consistent) or ``aic`` (detects weaker sources, and some false ones).

    Raises:
        InputError: An unknown rule, or fewer snapshots than elements.
    """
    elements = eigenvalues.shape[-1]
    check_choice(rule, ("mdl", "aic"), "a rule of", "or give a number of sources")
    if snapshots < elements:
        raise InputError(
            f"expected at least {elements} snapshots to count the sources on {elements} elements, "
            f"got {snapshots}; give sources as a number, more chirps, or smaller smoothing"
        )
    values = eigenvalues.detach().to(torch.float64).sort(-1).values
    # Eigenvalues below the rounding of the largest one are numerical noise.
    values = values.maximum(1e-14 * values[..., -1:].clamp(min=torch.finfo(torch.float64).tiny))
    remaining = torch.arange(1, elements + 1, dtype=torch.float64, device=values.device)
    spread = (values.cumsum(-1) / remaining).log() - values.log().cumsum(-1) / remaining
    found = elements - remaining  # k for each entry
    freedom = found * (2 * elements - found)
    penalty = freedom if rule == "aic" else 0.5 * math.log(snapshots) * freedom
    cost = snapshots * remaining * spread + penalty
    return elements - 1 - cost.argmin(-1)


class _SignalProjector(torch.autograd.Function):
    """Projector on the selected eigenvectors of Hermitian matrices.

    Its derivative in a direction D is Σ (vⱼvⱼᴴ D vᵢvᵢᴴ + h.c.)/(λᵢ − λⱼ) over pairs of i selected
    and j not: gaps within either set do not enter.
    """

    @staticmethod
    def forward(ctx: Any, matrix: _Matrices, chosen: Bool[Tensor, "*batch element"]) -> _Matrices:
        values, vectors = torch.linalg.eigh(matrix)
        ctx.save_for_backward(values, vectors, chosen)
        ctx.save_for_forward(values, vectors, chosen)
        picked = vectors * chosen[..., None, :]
        return picked @ picked.mH

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        values, vectors, chosen = ctx.saved_tensors
        gradient = 0.5 * (grad_outputs[0] + grad_outputs[0].mH)
        return _projector_change(values, vectors, chosen, gradient), None

    @staticmethod
    def jvp(ctx: Any, matrix: Tensor, _: None) -> Tensor:  # type: ignore[override]
        # The derivative is its own adjoint.
        values, vectors, chosen = ctx.saved_tensors
        return _projector_change(values, vectors, chosen, matrix)


def _projector_change(values: Tensor, vectors: Tensor, chosen: Tensor, change: Tensor) -> Tensor:
    """Return the derivative of the projector along a Hermitian change of the matrix."""
    gap = values[..., :, None] - values[..., None, :]
    smallest = _SMALLEST_GAP * values.abs().amax(-1)[..., None, None]
    between = chosen[..., :, None] != chosen[..., None, :]
    # Zero matrices have no scale; their derivative is set to zero.
    damped = gap / (gap.square() + smallest.square()).clamp(min=torch.finfo(gap.dtype).tiny)
    sign = torch.where(chosen[..., :, None], 1.0, -1.0)
    return vectors @ ((vectors.mH @ change @ vectors) * (between * sign * damped)) @ vectors.mH


def _snapshots(
    profile: Tensor, radar: Radar, grid: Grid, smoothing: _Subarray, forward_backward: bool
) -> _Snapshots:
    """Return snapshots of the distinct elements, including shifted subarrays and the reversed
    array.
    """
    what, do = "a profile (frame, snapshot, tx, rx, range)", "use those of range_profile"
    check_shape(profile, (None, None, *radar.shape[1:], grid.range_count), what, do)
    if not profile.numel():
        raise InputError(f"expected {what} with frames and snapshots, got none; {do}")
    array = aperture(radar)
    array.check_directions(grid)
    rows, columns = len(array.z), len(array.y)
    taken = array.counts.flatten() > 0
    channels = profile.to(torch.complex128).flatten(2, 3).movedim(-1, 1)
    plane = array.plane(channels).flatten(-2)[..., taken.to(channels.device)]
    y, z = array.y.repeat_interleave(rows)[taken], array.z.repeat(columns)[taken]
    uniform = bool(taken.all()) and _is_uniform(array.y) and _is_uniform(array.z)
    if (smoothing is not None or forward_backward) and not uniform:
        raise InputError(
            "expected a uniform rectangle of virtual elements for smoothing and "
            f"forward_backward, got {len(y)} elements on a {columns} × {rows} grid of places; "
            "leave both out for this array"
        )
    if smoothing is not None:
        if not (1 <= smoothing[0] <= columns and 1 <= smoothing[1] <= rows):
            raise InputError(
                f"expected subarrays of 1..{columns} × 1..{rows} elements, got {smoothing}; give "
                "the elements along y and along z"
            )
        shifted = plane.unflatten(-1, (columns, rows))
        shifted = shifted.unfold(-2, smoothing[0], 1).unfold(-2, smoothing[1], 1)
        plane = shifted.flatten(2, 4).flatten(-2, -1)
        y, z = (p.unflatten(0, (columns, rows))[: smoothing[0], : smoothing[1]] for p in (y, z))
        y, z = y.flatten(), z.flatten()
    if forward_backward:
        plane = torch.cat([plane, plane.flip(-1).conj()], dim=-2)
    return _Snapshots(plane, array, y, z)


def _is_uniform(positions: Float64[Tensor, " place"]) -> bool:
    steps = positions.diff()
    return len(steps) < 2 or bool((steps - steps.mean()).abs().max() <= _UNIFORMITY * steps.mean())
