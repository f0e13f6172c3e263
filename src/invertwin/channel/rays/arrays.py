"""Conversion between torch tensors and Dr.Jit arrays, and random numbers on the latter."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Float64
from torch import Tensor
from torch._C import _DisableFuncTorch

from invertwin.channel.rays.backend import Mask, backend, dr, mi, mit
from invertwin.checks import strip_derivatives


def to_float(values: Tensor) -> mit.Float:
    """Convert a torch tensor to a flat Dr.Jit float array (detached, float32)."""
    return mi.Float(_copy_aligned(values, torch.float32))


def to_double(values: Tensor) -> mit.Float64:
    """Convert a torch tensor to a flat Dr.Jit float64 array (detached)."""
    return mi.Float64(_copy_aligned(values, torch.float64))


def to_index(values: Tensor) -> mit.UInt32:
    """Convert a torch tensor of non-negative integers to a flat Dr.Jit index array."""
    return mi.UInt32(_copy_aligned(values, torch.uint32))


def to_signed(values: Tensor) -> mit.Int32:
    """Convert a torch tensor of integers to a flat Dr.Jit array."""
    return mi.Int32(_copy_aligned(values, torch.int32))


def _copy_aligned(values: Tensor, dtype: torch.dtype) -> np.ndarray | Tensor:
    """Copy a tensor into flat memory of torch, which is aligned to 64 bytes.

    Dr.Jit reads such memory in place; for other alignments, as NumPy's may be, it compiles separate
    kernels. What is on the GPU that traces stays there.
    """
    with _DisableFuncTorch():  # within `torch.func`, even new tensors are wrapped
        given = strip_derivatives(values)
        device = given.device if backend() == "cuda" else torch.device("cpu")
        flat = torch.empty(given.shape, dtype=dtype, device=device).copy_(given).ravel()
        return flat if flat.is_cuda else flat.numpy()


def to_points(values: Float64[Tensor, "n 3"] | Float32[Tensor, "n 3"]) -> mit.Float:
    """Convert points to a flat Dr.Jit array of four numbers each, the last one zero."""
    return to_float(torch.nn.functional.pad(values.detach().to(torch.float32), (0, 1)))


def to_vectors(kind: Any, values: Tensor) -> Any:
    """Convert rows of three numbers to a Dr.Jit vector type.

    Args:
        kind: type of the result, such as ``mi.Point3f`` (float32).
        values: rows of three numbers.
    """
    return kind(*(to_float(column) for column in values.T))


def gather_points(table: mit.Float, index: mit.UInt32, active: Mask = True) -> mit.Point3f:
    """Gather points of a table.

    Args:
        table: table of points, see ``to_points``.
        index: rows.
        active: mask of active lanes.
    """
    found = dr.gather(mi.Vector4f, table, index, active)
    return mi.Point3f(found.x, found.y, found.z)


def from_points(values: mit.Float) -> Float32[Tensor, "n 3"]:
    """Convert a table of points, or derivatives with respect to one, to torch."""
    return to_torch(values).reshape(-1, 4)[:, :3]


def to_torch(values: mit.Float | mit.UInt32 | mit.Int32 | mit.Bool) -> Tensor:
    """Copy a flat Dr.Jit array to a torch tensor on the CPU."""
    return torch.from_numpy(np.array(values))


def view_as_torch(values: mit.Float) -> Tensor:
    """View a flat Dr.Jit array as a torch tensor, read-only; arrays on a GPU are copied to the CPU.

    Args:
        values: flat Dr.Jit array.
    """
    dr.eval(values)
    dr.sync_thread()
    return to_torch(values) if backend() == "cuda" else torch.from_dlpack(values)


def opaque(value: float | int, type_name: str = "UInt32") -> Any:
    """Create a Dr.Jit scalar in memory, so that a new value does not recompile the kernel.

    Args:
        value: number.
        type_name: name of its Dr.Jit type.
    """
    return dr.opaque(getattr(mi, type_name), value)


def scramble_seed(seed: int, stream: int) -> mit.UInt32:
    """Derive an opaque 32-bit seed; neighbouring seeds and streams are unrelated.

    Args:
        seed: seed of the user.
        stream: number of the stream.
    """
    return opaque(int(np.random.SeedSequence([seed, stream]).generate_state(1)[0]))


def uniform_pair(
    index: mit.UInt32 | tuple[mit.UInt32, mit.UInt32], seed: mit.UInt32
) -> tuple[mit.Float, mit.Float]:
    """Draw two uniform numbers in [0, 1) for each index.

    Args:
        index: indices, one per lane.
        seed: seed from ``scramble_seed``.
    """
    first, second = mi.sample_tea_32(index, seed)
    return mi.Float(first >> 8) * 2.0**-24, mi.Float(second >> 8) * 2.0**-24


def tangent_frame(normal: mit.Vector3f) -> Any:
    """Build a frame about a unit normal.

    Mitsuba's tangents single out z. Here they single out the boresight, x: draws of a seed follow
    the scene where its axes are permuted.

    Args:
        normal: third axis of the frame.
    """
    turned = mi.Frame3f(mi.Vector3f(normal.y, normal.z, normal.x))
    s, t = (mi.Vector3f(v.z, v.x, v.y) for v in (turned.s, turned.t))
    return mi.Frame3f(s, t, mi.Vector3f(normal))


def sample_sphere(first: mit.Float, second: mit.Float) -> mit.Vector3f:
    """Sample a direction uniformly.

    Args:
        first, second: uniform numbers; the first one counts from the boresight.
    """
    sphere = mi.warp.square_to_uniform_sphere(mi.Point2f(first, second))
    return mi.Vector3f(sphere.z, sphere.x, sphere.y)
