"""Metasurfaces: panels of many small elements, each of which shifts the phase of its echo.

The field from antenna to antenna over a panel is the sum over its elements,
``(λ/4π)(−j) Σ (d²/λ) ½(cosθ_t + cosθ_r)/(r₁r₂) V_t V_r A e^{−jk(r₁+r₂) + jφ}``, near the panel as
well as far from it. V is the part of an element's cell that an antenna sees.

Source: derivations §12.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor
from torch.nn.functional import normalize
from torch.utils.checkpoint import checkpoint

from invertwin import channel, checks
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.limits import MAX_LENGTH
from invertwin.runtime.memory import require_at_most
from invertwin.scene import Scene
from invertwin.scene.antenna import centre_positions
from invertwin.scene.material.fresnel import safe_root

_VALUES_PER_CHUNK = 1 << 22  # of antennas and elements
_UP = (0.0, 0.0, 1.0)  # of V in ``RayPaths``
_MAX_BITS = 8


@dataclass(frozen=True, eq=False)
class Metasurface:
    """Flat panel of equal elements in rows and columns, which scatters into its front half space.

    A panel is not an object of the scene: it blocks nothing, and surfaces behind it reflect as if
    it were absent.

    Attributes:
        position: Centre of the panel [3] [m].
        axes: Rotation matrix [3, 3]; columns are the normal, the y and the z axis in the world.
        phase: Phases of the elements along y and z [rad]; 0 = a reflector that inverts the field.
        spacing: Element spacing along y and z, and size of an element's cell [m]. With half a
            wavelength or less, the sum equals the integral over a plate.
        amplitude: Amplitude of all elements, or one for each; 1 = the cell scatters all incident
            power.
        bits: Number of bits to which phases are rounded, with the straight-through estimator for
            derivatives; None = not rounded.
        pattern: Pattern of an element about its normal. None = aperture pattern ½(cosθ_t + cosθ_r),
            which is cut off at the panel's plane.

    Raises:
        InputError: Wrong shapes, axes that are not orthonormal, or a number out of range.
    """

    position: Float64[Tensor, "3"]
    axes: Float64[Tensor, "3 3"]
    phase: Float64[Tensor, "y z"]
    spacing: float
    amplitude: float | Float64[Tensor, "_ _"] = 1.0
    bits: int | None = None
    pattern: channel.GainPattern | None = None

    def __post_init__(self) -> None:
        what = "of a metasurface"
        place = checks.checked_point(self.position, f"position {what}", most=MAX_LENGTH)
        axes = checks.checked_tensor(self.axes, (3, 3), f"axes {what}", "give them as columns")
        checks.check_orthonormal(axes, f"axes {what}", "give the normal, y and z")
        do = "give one for each element, along y and z"
        phase = checks.checked_tensor(self.phase, (None, None), f"phases {what} [rad]", do)
        checks.check_some(phase.ravel(), f"element {what}", do)
        amplitude = checks.to_tensor(self.amplitude, "amplitudes", "give numbers")
        amplitude = amplitude.expand(phase.shape) if amplitude.ndim == 0 else amplitude
        do = "give one, or one for each"
        amplitude = checks.checked_tensor(amplitude, tuple(phase.shape), f"amplitudes {what}", do)
        if bool((amplitude.detach() < 0).any()):
            raise InputError(f"expected amplitudes {what} of at least 0, got less; turn the phase")
        checks.checked_number(self.spacing, f"spacing {what} [m]", 0.0, open_low=True)
        if self.bits is not None:
            bits = checks.checked_count(self.bits, f"bits {what}", 1)
            require_at_most(bits, _MAX_BITS, f"bits {what}", "use None")
        checks.set_fields(self, position=place, axes=axes, phase=phase, amplitude=amplitude)

    @property
    def cells(self) -> channel.PanelCells:
        """Cells of the elements, in row-major order of (y, z)."""
        offsets = [centre_positions(n, self.spacing, "elements") for n in self.phase.shape]
        grid = torch.stack(torch.meshgrid(*offsets, indexing="ij"), -1).reshape(-1, 2)
        return channel.PanelCells(self.position, self.axes, grid, (self.spacing, self.spacing))

    @property
    def response(self) -> Complex128[Tensor, " element"]:
        """Reflection factor of every element, after rounding of its phase."""
        phase = self.phase.ravel()
        if self.bits is not None:
            step = 2 * math.pi / 2**self.bits
            phase = phase + ((phase / step).round() * step - phase).detach()
        assert isinstance(self.amplitude, Tensor)
        return torch.polar(self.amplitude.ravel(), phase)

    def focus(
        self, tx: checks.ArrayLike, target: checks.ArrayLike, frequency: float
    ) -> "Metasurface":
        """Return the panel with additional phases that focus a transmitter on a point.

        Args:
            tx: Position of the transmitter [3] [m].
            target: Focal point [3] [m].
            frequency: [Hz].
        """
        ends = [checks.checked_point(p, "ends of a focus [m]") for p in (tx, target)]
        length = (self.cells.centers[:, None] - torch.stack(ends)).norm(dim=2).sum(1)
        turn = 2 * math.pi * frequency / SPEED_OF_LIGHT * length
        return replace(self, phase=self.phase + turn.view(self.phase.shape))


def panel_response(
    scene: Scene,
    panel: Metasurface,
    tx: Float64[Tensor, "tx 3"],
    rx: Float64[Tensor, "rx 3"],
    frequency: float,
    *,
    blur: float = 0.0,
    boundary: bool = True,
    far_field: bool = False,
) -> Complex128[Tensor, "tx rx"]:
    """Sum over a panel's elements for fields unchanged by a reflector, with isotropic antennas.

    The phase is relative to that of the path over the panel's centre, ``e^{−jk(R₁+R₂)}``.

    Args:
        scene: Propagation environment.
        panel: The metasurface.
        tx, rx: Places of the antennas [m].
        frequency: [Hz].
        blur: Additional width of penumbras on the panel [m].
        boundary: False = derivatives at fixed visibility of the panel.
        far_field: True = plane waves over the panel: faster, accurate beyond 2D²/λ.
    """
    cells, k = panel.cells, 2 * math.pi * frequency / SPEED_OF_LIGHT
    lit = channel.visible_fractions(scene, torch.cat([tx, rx]), cells, blur=blur, boundary=boundary)
    sent = _element_waves(panel, cells, tx, lit[: len(tx)], k, far_field)
    weights, scale = panel.response, panel.spacing**2 * k / (2 * math.pi)
    live = torch.nonzero((lit[len(tx) :] > 0).any(1) & bool((lit[: len(tx)] > 0).any()))[:, 0]
    heavy = len(live) * len(weights) > _VALUES_PER_CHUNK
    found = [torch.zeros(len(tx), 0, dtype=torch.complex128)]

    def sum_elements(positions: Tensor, visible: Tensor) -> Tensor:
        wave, cosine = _element_waves(panel, cells, positions, visible, k, far_field)
        first = sent[0] * weights
        if panel.pattern is not None:
            return (first * sent[1]) @ (wave * cosine).T
        half = (first * sent[1]) @ (wave * (cosine > 0)).T
        return 0.5 * (half + (first * (sent[1] > 0)) @ (wave * cosine).T)

    for some in live.split(max(1, _VALUES_PER_CHUNK // len(weights))):
        rows = rx[some], lit[len(tx) + some]
        found.append(
            checkpoint(sum_elements, *rows, use_reentrant=False) if heavy else sum_elements(*rows)
        )
    sums = torch.zeros(len(tx), len(rx), dtype=torch.complex128)
    return sums.index_copy(1, live, -1j / (2 * k) * scale * torch.cat(found, 1))


def _element_waves(
    panel: Metasurface,
    cells: channel.PanelCells,
    positions: Tensor,
    visible: Tensor,
    wave_number: float,
    far_field: bool,
) -> tuple[Complex128[Tensor, "place element"], Float64[Tensor, "place element"]]:
    """Wave of each place at each element, over its phase at the centre, and its obliquity."""
    whole = (positions - panel.position) @ panel.axes
    reach = whole.norm(dim=1, keepdim=True)
    shift = -whole[:, 1:] @ cells.offsets.T
    if far_field:
        later, length = shift / reach, reach.expand_as(shift)
    else:
        # The difference of squares is exact where that of lengths would cancel.
        squares = 2 * shift + cells.offsets.square().sum(1)
        length = (reach.square() + squares).sqrt()
        later = squares / (length + reach)
    if panel.pattern is None:
        obliquity = whole[:, :1].clamp_min(0) / length
    else:
        aside = whole[:, None, 1:] - (0 if far_field else cells.offsets)
        ahead = whole[:, None, :1].expand(-1, len(cells.offsets), 1)
        toward = torch.cat([ahead, aside.expand(*ahead.shape[:2], 2)], 2) / length[..., None]
        # Of a cell of λ/2, π is the gain that takes all of what falls on it.
        obliquity = safe_root(panel.pattern.gain(toward) / math.pi, 0.0)
    return torch.polar(visible / length, -wave_number * later), obliquity


def panel_paths(
    scene: Scene,
    panels: Metasurface | Sequence[Metasurface],
    tx: checks.ArrayLike,
    rx: checks.ArrayLike,
    frequency: float,
    *,
    blur: float = 0.0,
    boundary: bool = True,
    far_field: bool = False,
) -> channel.RayPaths:
    """Paths over metasurfaces: one per panel and link, with the sum over its elements.

    Paths have the delay of the path over the panel's centre, and the polarisation of a reflector
    there. Add them to those of ``trace_paths`` by ``+``; responses then sum all paths coherently.
    Antennas are at rest. Paths between panel and antennas are straight and may be occluded.

    Args:
        scene: Propagation environment.
        panels: One or several metasurfaces, without paths between them.
        tx: Transmitters, [3] or [tx, 3] in the world [m].
        rx: Receivers, [3] or [rx, 3] [m].
        frequency: Frequency of the coefficients [Hz].
        blur: Additional width of penumbras on a panel [m]; a positive value smooths the loss of a
            fit.
        boundary: False = derivatives at fixed visibility of the panels, for ablation.
        far_field: True = plane waves over a panel: faster, accurate beyond 2D²/λ.

    Raises:
        InputError: Wrong shapes or numbers, or an antenna within a spacing of a panel.

    Source: derivations §12.
    """
    several = [panels] if isinstance(panels, Metasurface) else list(panels)
    ends = checks.checked_rows(tx, "tx places [m]"), checks.checked_rows(rx, "rx places [m]")
    checks.checked_number(frequency, "frequency [Hz]", 0.0, open_low=True)
    checks.checked_number(blur, "width of shadows [m]", 0.0)
    rows: list[channel.RayPaths] = []
    for panel in several:
        _require_clearance(panel, torch.cat(ends))
        response = panel_response(
            scene, panel, *ends, frequency, blur=blur, boundary=boundary, far_field=far_field
        )
        rows.append(_paths_over_panel(panel, ends, response, frequency, scene.names))
    checks.check_some(rows, "metasurface", "give one")
    return sum(rows[1:], start=rows[0]).sort_rows()


def _paths_over_panel(
    panel: Metasurface,
    ends: tuple[Tensor, Tensor],
    response: Complex128[Tensor, "tx rx"],
    frequency: float,
    names: tuple[str, ...],
) -> channel.RayPaths:
    """One path over a panel for each pair of antennas between which it passes something on."""
    total, hearers = response.ravel(), response.shape[1]
    link = torch.nonzero(total.detach() != 0)[:, 0]
    source, target = link // hearers, link % hearers
    ways = [panel.position - ends[0][source], panel.position - ends[1][target]]
    units = [normalize(way, dim=1) for way in ways]
    up = torch.tensor(_UP, dtype=torch.float64)
    sent, received = (channel.polarisations(unit, up) for unit in units)
    normal = panel.axes[:, 0]
    turned = sent - 2 * (sent @ normal)[..., None] * normal
    delay = (ways[0].norm(dim=1) + ways[1].norm(dim=1)) / SPEED_OF_LIGHT
    field = total[link, None, None] * (received @ turned.mT)
    one = torch.ones(len(link), 1, dtype=torch.int64)
    points, kinds = panel.position.expand(len(link), 1, 3), channel.METASURFACE * one
    columns = source, target, delay, field, units[0], units[1], points, kinds, -one, -one
    return channel.RayPaths(
        (len(response), hearers), frequency, *columns, names, torch.zeros_like(delay)
    )


def _require_clearance(panel: Metasurface, positions: Tensor) -> None:
    local = (positions.detach() - panel.position.detach()) @ panel.axes.detach()
    half = 0.5 * panel.spacing * torch.tensor(panel.phase.shape, dtype=torch.float64)
    beyond = (local[:, 1:].abs() - half).clamp_min(0)
    if float((beyond.square().sum(1) + local[:, 0].square()).min()) < panel.spacing**2:
        raise InputError(
            "expected antennas at least a spacing away from a metasurface, got one on it; move it"
        )
