"""Small scenes that several rooms are tested on."""

from collections.abc import Sequence

import torch
from torch import Tensor

from invertwin.channel import Grid, Link
from invertwin.radar import FMCW, Radar
from invertwin.scene import (
    AntennaArray,
    Isotropic,
    Material,
    Mesh,
    Object,
    Pattern,
    RoughDielectric,
    Scene,
    linear_array,
    plate,
    rigid,
    rotation_from_vector,
)

WAVELENGTH = 3.893e-3
GRID = Grid(0.4, 0.075, 34, u_start=-0.6, u_step=0.1, u_count=13)


def float64(values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def complex128(values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.complex128)


def thing(
    mesh: Mesh,
    at: Sequence[float] = (0.0, 0.0, 0.0),
    turn: Sequence[float] = (0.0, 0.0, 0.0),
    material: Material | None = None,
) -> Object:
    """An object at a place, turned by a rotation vector [rad]; rough unless said otherwise."""
    pose = rigid(rotation_from_vector(float64(turn)), float64(at))
    return Object(mesh, material or RoughDielectric(4.0), pose)


def occluder(**materials: Material) -> Scene:
    """A plate 1 m away, turned a little, and a wall 2 m away: visibility changes with both."""
    return Scene(
        {
            "wall": thing(plate(2.0, 2.0, divisions=2), (2, 0, 0), material=materials.get("wall")),
            "occluder": thing(
                plate(0.4, 0.3), (1, 0.1, 0.05), (0, 0.1, 0.2), materials.get("occluder")
            ),
        }
    )


def level_plate(width: float, depth: float, divisions: int = 1) -> Mesh:
    """A plate that lies in the plane z = 0: its width along x, its depth along y."""
    mesh = plate(width, depth, divisions)
    return Mesh(mesh.vertices[:, [1, 2, 0]], mesh.faces)


def link(
    tx: object = ((0.0, 0.0, 0.0),),
    rx: object = None,
    rotations: Tensor | None = None,
    pattern: Pattern | None = None,
    *,
    wavelength: float = WAVELENGTH,
    shared: bool | None = None,
) -> Link:
    """Antennas at the given places, looking along x; visibility is shared if they coincide."""
    places = tx if isinstance(tx, Tensor) else float64(tx)
    others = places if rx is None else rx if isinstance(rx, Tensor) else float64(rx)
    if rotations is None:
        rotations = torch.eye(3, dtype=torch.float64).expand(len(places), 3, 3)
    gain = pattern or Isotropic()
    return Link(
        places,
        others,
        rotations,
        gain,
        gain,
        wavelength,
        (rx is None) if shared is None else shared,
    )


def radar(positions: object = ((0.0, 0.0, 0.0),), receivers: int = 16) -> Radar:
    """77 GHz, 2 GHz of bandwidth, one transmitter, a row of receivers."""
    return Radar(
        AntennaArray(torch.zeros(1, 3, dtype=torch.float64)),
        linear_array(receivers, 1.9467e-3),
        FMCW(76e9, 2e9, 50e-6, 64),
        positions if isinstance(positions, Tensor) else float64(positions),
        array_window="rectangular",
    )


def relative(found: Tensor, truth: Tensor) -> float:
    """‖found − truth‖₁ / ‖truth‖₁."""
    found, truth = found.detach(), truth.detach()
    return float((found - truth).abs().sum() / truth.abs().sum())


def noise(maps: Sequence[Tensor]) -> float:
    """Standard deviation of one of several estimates, L1 over bins, relative to their mean."""
    found = torch.stack([each.detach() for each in maps])
    return float(found.std(0).sum() / found.mean(0).abs().sum())


def shift_error(gradients: Sequence[Tensor]) -> float:
    """How far the derivatives with respect to all points [*, 3] are from summing to zero.

    The points are those of a scene and its antennas: to move everything alike changes nothing. The
    error is relative to the sum of magnitudes, and 0 where all derivatives are 0.
    """
    total = torch.stack([gradient.sum(0) for gradient in gradients]).sum(0).abs().max()
    scale = torch.stack([gradient.abs().sum() for gradient in gradients]).sum()
    return float(total / scale) if float(scale) != 0 else 0.0
