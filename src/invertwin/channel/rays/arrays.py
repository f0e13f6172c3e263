"""The one crossing between torch tensors and Dr.Jit arrays, and random numbers on the latter."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Float64
from torch import Tensor
from torch._C import _DisableFuncTorch

from invertwin.channel.rays.backend import dr, mi
from invertwin.checks import strip_derivatives


def to_float(values: Tensor) -> Any:
    """A flat Dr.Jit float array of a torch tensor (detached, float32)."""
    return mi.Float(_copy_aligned(values, torch.float32))


def to_double(values: Tensor) -> Any:
    """A flat Dr.Jit float64 array of a torch tensor (detached)."""
    return mi.Float64(_copy_aligned(values, torch.float64))


def to_index(values: Tensor) -> Any:
    """A flat Dr.Jit index array of a torch tensor of non-negative integers."""
    return mi.UInt32(_copy_aligned(values, torch.int32).view(np.uint32))


def to_signed(values: Tensor) -> Any:
    """A flat Dr.Jit array of a torch tensor of integers."""
    return mi.Int32(_copy_aligned(values, torch.int32))


def _copy_aligned(values: Tensor, dtype: torch.dtype) -> np.ndarray:
    """A flat copy in torch's own memory, which begins at a multiple of 64 bytes.

    Dr.Jit reads such memory in place. Where it begins elsewhere, as NumPy's may, Dr.Jit compiles
    kernels of their own for it.
    """
    with _DisableFuncTorch():  # within `torch.func`, even new tensors are wrapped
        given = strip_derivatives(values).cpu()
        return torch.empty(given.shape, dtype=dtype).copy_(given).ravel().numpy()


def to_points(values: Float64[Tensor, "n 3"] | Float32[Tensor, "n 3"]) -> Any:
    """A flat Dr.Jit array of four numbers a point, the last one zero: each is read as a whole."""
    return to_float(torch.nn.functional.pad(values.detach().to(torch.float32), (0, 1)))


def gather_points(table: Any, index: Any, active: Any = True) -> Any:
    """Points of such an array.

    Args:
        table: From ``to_points``.
        index: Rows.
        active: Lanes.
    """
    found = dr.gather(mi.Vector4f, table, index, active)
    return mi.Point3f(found.x, found.y, found.z)


def from_points(values: Any) -> Float32[Tensor, "n 3"]:
    """Points of such an array, or derivatives with respect to them."""
    return to_torch(values).reshape(-1, 4)[:, :3]


def to_torch(values: Any) -> Tensor:
    """A torch tensor on the CPU of a flat Dr.Jit array."""
    return torch.from_numpy(np.array(values))


def view_as_torch(values: Any) -> Tensor:
    """The same as ``to_torch``, but in Dr.Jit's own memory where that is the CPU's: only to read.

    Args:
        values: A flat Dr.Jit array.
    """
    dr.eval(values)
    dr.sync_thread()
    return torch.from_dlpack(values).cpu()


def opaque(value: float | int, type_name: str = "UInt32") -> Any:
    """A Dr.Jit scalar that the kernel reads from memory, so that a new value does not recompile.

    Args:
        value: The number.
        type_name: Its Dr.Jit type.
    """
    return dr.opaque(getattr(mi, type_name), value)


def scramble_seed(seed: int, stream: int) -> Any:
    """An opaque 32-bit seed; neighbouring seeds and streams are unrelated.

    Args:
        seed: Of the user.
        stream: Number of the use.
    """
    state = np.random.SeedSequence([seed, stream]).generate_state(1)[0]
    return opaque(int(state))


def uniform_pair(index: Any, seed: Any) -> tuple[Any, Any]:
    """Two uniform numbers in [0, 1) for each index.

    Args:
        index: One a lane.
        seed: From ``scramble_seed``.
    """
    first, second = mi.sample_tea_32(index, seed)
    return mi.Float(first >> 8) * 2.0**-24, mi.Float(second >> 8) * 2.0**-24


def corners(vertices: Any, faces: Any, face: Any, active: Any = True) -> tuple[Any, Any, Any]:
    """Corners of triangles, from tables of points and of vertex indices.

    Args:
        vertices: Table of points.
        faces: Vertex indices of triangles, four numbers each.
        face: Triangles.
        active: Lanes.
    """
    index = dr.gather(mi.Vector4u, faces, face, active)
    return tuple(gather_points(vertices, index[k], active) for k in range(3))  # type: ignore[return-value]


def interpolate_position(triangle: tuple[Any, Any, Any], b1: Any, b2: Any) -> Any:
    """The point of a triangle with these barycentric coordinates.

    Args:
        triangle: Its corners.
        b1, b2: Barycentric coordinates.
    """
    p0, p1, p2 = triangle
    return p0 * (1 - b1 - b2) + p1 * b1 + p2 * b2
