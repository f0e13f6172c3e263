"""Conversion of paths of Sionna RT."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from invertwin.channel import KINDS, RayPaths
from invertwin.errors import InputError

# What Sionna calls reflection, refraction, and diffraction; 2 is diffuse reflection.
_NAMES = {1: "reflection", 4: "transmission", 8: "diffraction"}
_KINDS = {0: 0} | {number: KINDS.index(name) for number, name in _NAMES.items()}


def ray_paths_from_sionna(paths: Any, frequency: float) -> RayPaths:
    """Convert the `Paths` of Sionna RT 2.2 to ``RayPaths``.

    Its arrays must have one element with ``pattern="iso"`` and ``polarization="VH"``, so that its
    coefficients are complete 2 × 2 matrices. Indices of objects and triangles are not available.
    The phase convention of Sionna RT is kept: sheets reflect at their surface, and path lengths
    count their thickness twice.

    Args:
        paths: Paths from its `PathSolver`.
        frequency: Frequency of its scene [Hz].

    Raises:
        InputError: Other arrays, or diffuse reflection.
    """
    real, imaginary = (np.asarray(part, dtype=np.float64) for part in paths.a)
    field = real + 1j * imaginary
    if field.ndim != 5 or field.shape[1] != 2 or field.shape[3] != 2:
        raise InputError(
            "expected paths of arrays of one element with polarization 'VH', got coefficients of "
            f"shape {list(field.shape)}; use PlanarArray(num_rows=1, num_cols=1, pattern='iso', "
            "polarization='VH') for both"
        )
    valid = np.asarray(paths.valid).astype(bool)  # [rx, tx, path]
    rx, tx, _ = np.nonzero(valid)
    kinds = np.moveaxis(np.asarray(paths.interactions), 0, -1)[valid].astype(np.int64)
    unknown = sorted(set(np.unique(kinds).tolist()) - set(_KINDS))
    if unknown:
        raise InputError(
            f"expected specular, refracted and diffracted paths, got interactions {unknown}; "
            "trace with diffuse_reflection=False"
        )
    places = np.moveaxis(np.asarray(paths.vertices, dtype=np.float64), 0, -2)[valid]
    known = np.vectorize(_KINDS.__getitem__, otypes=[np.int64])(kinds) if kinds.size else kinds
    matrix = np.moveaxis(field, (0, 2, 4, 1, 3), (0, 1, 2, 3, 4))[valid]
    delay, doppler = _rows(paths.tau, valid), _rows(paths.doppler, valid)
    departure = _unit_vectors(paths.theta_t, paths.phi_t, valid)
    arrival = _unit_vectors(paths.theta_r, paths.phi_r, valid)
    points = np.where((known > 0)[..., None], places, 0.0)
    unknown_surface = torch.full(known.shape, -1, dtype=torch.int64)
    arrays = tx, rx, np.ascontiguousarray(matrix), points, known
    sources, targets, field, vertices, kinds = (torch.from_numpy(array) for array in arrays)
    columns = sources, targets, delay, field, departure, arrival, vertices, kinds
    where = unknown_surface, unknown_surface, (), doppler
    counts = valid.shape[1], valid.shape[0]
    return RayPaths(counts, float(frequency), *columns, *where).sort_rows()


def _rows(values: Any, valid: np.ndarray) -> Tensor:
    return torch.from_numpy(np.asarray(values, dtype=np.float64)[valid])


def _unit_vectors(theta: Any, phi: Any, valid: np.ndarray) -> Tensor:
    polar, around = _rows(theta, valid), _rows(phi, valid)
    ring = polar.sin()
    return torch.stack([ring * around.cos(), ring * around.sin(), polar.cos()], 1)
