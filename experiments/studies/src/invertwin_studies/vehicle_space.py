"""The public learned space of vehicles: a reader, a shape and an unknown of run files."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from invertwin.cli.schema.shape_tables import ObjectTable
from invertwin.errors import InputError
from invertwin.limits import Count, Positive
from invertwin.registry.section import InputPath
from invertwin.scene import LinearShape, Mesh, ShapeSpace
from invertwin.scene.files import load_mesh
from invertwin.scene.remeshing import remesh
from invertwin.storage.untrusted import read_arrays

Level = Literal["coarse", "fine"]
_TRAINED = 79  # vehicles behind the public space: σ of mode k is its singular value over √79
_LEVELS = {"coarse": ("default_dodec", "dodec_mean.obj"), "fine": ("default1", "body_mean.obj")}
_ORIGINAL = "github.com/mleotta/vehicle3d"


def vehicle(
    folder: InputPath = "vehicle_prior",
    level: Level = "fine",
    coefficients: Sequence[float] = (),
    max_edge: Positive | None = None,
) -> Mesh:
    """The body of a car of the public learned space: x ahead, y to the left, z up.

    Args:
        folder: path, from the run file's folder, then from INVERTWIN_DATA.
        level: of detail.
        coefficients: of the first modes, in standard deviations; the others are 0.
        max_edge: m, longest edge of the mesh; without it as in the file.
    """
    space = load_vehicle_space(folder, level)
    mesh = space.mesh(space.mean.new_tensor(coefficients))
    return mesh if max_edge is None else remesh(mesh, max_edge)


def vehicle_coordinates(
    object: str,
    table: ObjectTable | None = None,
    folder: InputPath = "vehicle_prior",
    level: Level = "fine",
    modes: Count = 10,
) -> LinearShape:
    """Coordinates of the public space of vehicles, from those of its object, else the mean.

    Args:
        object: name of the object.
        table: of the object; its coordinates count where they are of the same space.
        folder: path, from the run file's folder, then from INVERTWIN_DATA.
        level: of detail.
        modes: coordinates that are fitted.

    Raises:
        InputError: files are missing, or fewer modes than the object has coefficients.
    """
    start = torch.zeros(modes, dtype=torch.float64)
    known: Any = table
    same = getattr(known, "shape", None) == "vehicle"
    if same and (known.folder, known.level) == (folder, level):
        count = len(known.coefficients)
        if count > modes:
            raise InputError(
                f"expected at least as many modes as {object} has coefficients, {count}, got "
                f"{modes}; raise modes"
            )
        start[:count] = start.new_tensor(known.coefficients)
    return LinearShape(object, load_vehicle_space(folder, level), start)


def load_vehicle_space(folder: str | Path, level: Level = "fine") -> ShapeSpace:
    """The public learned space of vehicles, bodies without wheels.

    The frame is that of the files: x ahead, y to the left, z up, metres.

    Args:
        folder: holds ``vehicle3d_pca.npz``, ``body_mean.obj`` and ``dodec_mean.obj``.
        level: ``fine`` has 127 vertices and 78 modes, ``coarsen_map`` 16 and 14.

    Raises:
        InputError: no such level, files missing, or arrays that do not fit.
    """
    if level not in _LEVELS:
        raise InputError(f"expected level 'coarse' or 'fine', got {level!r}; choose one")
    name, mean_file = _LEVELS[level]
    file = Path(folder) / "vehicle3d_pca.npz"
    if not file.is_file():
        raise InputError(
            f"expected the vehicle space {file.name} in {folder}, got no such file; "
            f"set INVERTWIN_DATA to the folder that holds vehicle_prior/ ({_ORIGINAL})"
        )
    wanted = [f"{name}_{part}" for part in ("mean", "pc", "sv")]
    arrays = read_arrays(file, f"load the original ({_ORIGINAL})", wanted)
    missing = [key for key in wanted if key not in arrays]
    if missing:
        raise InputError(f"expected {missing[0]} in {file.name}, got none; load the original")
    mean, components, singular = (arrays[key].astype(np.float64) for key in wanted)
    mesh = load_mesh(Path(folder) / mean_file)
    count = len(mesh.vertices)
    # Rows hold the body's vertices, then the wheels', then points in the plane of images.
    vertices = torch.from_numpy(mean[: 3 * count].reshape(count, 3))
    return ShapeSpace(
        vertices,
        torch.from_numpy(components[: 3 * count].reshape(count, 3, -1)),
        torch.from_numpy(singular / np.sqrt(_TRAINED)),
        _reordered(mesh, vertices),
    )


def _reordered(mesh: Mesh, vertices: Tensor) -> Tensor:
    """The mesh's triangles in the numbers of the same vertices in another order."""
    gaps, index = torch.cdist(mesh.vertices, vertices).min(dim=1)
    if float(gaps.max()) > 1e-4 or len(index.unique()) != len(vertices):
        raise InputError(
            "expected the mean shape and its mesh to have the same vertices, got some "
            f"{float(gaps.max()):.3g} m apart; load files of one release"
        )
    return index[mesh.faces]
