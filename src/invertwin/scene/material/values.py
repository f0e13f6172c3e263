"""Types and ranges of material values: numbers, one per triangle, or textures."""

import math
from collections.abc import Mapping
from dataclasses import InitVar, dataclass
from typing import Annotated, NamedTuple

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.checks import ArrayLike, checked_number, checked_tensor, set_fields
from invertwin.constants import read_table
from invertwin.errors import InputError
from invertwin.limits import AllowedValues
from invertwin.scene.mesh import Mesh, checked_faces


@dataclass(frozen=True, eq=False)
class Texture:
    """Values over a surface from an image, sampled at the centroid of every triangle.

    The value is constant on each triangle, so detail finer than the mesh is lost unless the mesh is
    subdivided. The image is interpolated bilinearly between pixel centres and clamped at its
    border. Values are differentiable with respect to the image.

    Attributes:
        image: values by row and column, the top row first.
        uv: texture coordinates of the corners of every triangle: u from 0 at the left border of
            the image to 1 at the right, v from 0 at the bottom to 1 at the top. With `faces`, one
            pair per vertex instead.

    Args:
        faces: vertex indices of the triangles [f, 3], if `uv` is per vertex.

    Raises:
        InputError: wrong shapes, an empty image, NaN, or an index beyond the vertices.
    """

    image: Float64[Tensor, "row column"]
    uv: Float64[Tensor, "f 3 2"] | Float64[Tensor, "v 2"]
    faces: InitVar[ArrayLike | None] = None

    def __post_init__(self, faces: ArrayLike | None) -> None:
        image = _checked_image(self.image)
        if faces is None:
            do = "give u, v of every corner, or of every vertex with `faces`"
            uv = checked_tensor(self.uv, (None, 3, 2), "uv of a texture", do)
        else:
            do = "give u, v of every vertex"
            vertices = checked_tensor(self.uv, (None, 2), "uv of a texture", do)
            uv = vertices[checked_faces(faces, len(vertices))]
        set_fields(self, image=image, uv=uv.detach())

    @classmethod
    def from_projection(cls, image: ArrayLike, mesh: Mesh) -> "Texture":
        """Project an image onto a mesh along its x axis, upright as seen from a radar at −x.

        The left and right borders are at the maximum and minimum y of the mesh, bottom and top at
        the minimum and maximum z, in the object's own frame.

        Args:
            image: values of the pixels [row, column].
            mesh: mesh to cover.

        Raises:
            InputError: a mesh without width or height, or a bad image.
        """
        corners = mesh.vertices.detach()[:, 1:]
        low, high = corners.min(0).values, corners.max(0).values
        size = high - low
        if not bool((size > 0).all()):
            raise InputError(
                "expected a mesh with width and height along its y and z axes for a texture, "
                f"got {size.tolist()} m; give uv coordinates"
            )
        # +y is on the left of who looks along x.
        uv = torch.stack([high[0] - corners[:, 0], corners[:, 1] - low[1]], 1) / size
        return cls(_checked_image(image), uv, mesh.faces)

    @property
    def values(self) -> Float64[Tensor, " f"]:
        """Return the value of every triangle: the image at the mean of its corners' coordinates."""
        rows, columns = self.image.shape
        u, v = self.uv.mean(1).unbind(-1)
        # Pixel centres lie half a pixel inside the border.
        x = (u * columns - 0.5).clamp(0, columns - 1)
        y = ((1 - v) * rows - 0.5).clamp(0, rows - 1)
        left = x.floor().long().clamp(max=max(columns - 2, 0))
        top = y.floor().long().clamp(max=max(rows - 2, 0))
        right, bottom = (left + 1).clamp(max=columns - 1), (top + 1).clamp(max=rows - 1)
        a, b = x - left, y - top
        upper = self.image[top, left] * (1 - a) + self.image[top, right] * a
        lower = self.image[bottom, left] * (1 - a) + self.image[bottom, right] * a
        return upper * (1 - b) + lower * b


def _checked_image(image: object) -> Tensor:
    pixels = checked_tensor(image, (None, None), "image of a texture", "give rows of pixels")
    if not pixels.numel():
        raise InputError("expected an image of a texture with pixels, got none; give some")
    return pixels


_MAX_VALUE = 1e15  # of any field; the kernel's float32 holds its square

Value = float | ArrayLike | Texture
"""A number or 0-d tensor for the whole object, one number per triangle [f], or a texture."""


class ValueRange(NamedTuple):
    """Name of a value in messages, and its range."""

    what: str
    low: float
    high: float = math.inf
    open_low: bool = False


RANGES: Mapping[str, ValueRange] = {
    name: ValueRange(**row)
    for name, row in read_table("invertwin.scene.material", "ranges.toml").items()
}
"""Ranges of the material values by field name."""

MaterialValue = Annotated[str, AllowedValues(tuple(RANGES))]


def checked_value(value: object, name: str) -> Value:
    """Validate the value of a field; lists and arrays become tensors.

    Args:
        value: a number, one per triangle, or a `Texture`.
        name: name of a field of `RANGES`.

    Raises:
        InputError: not a number, a row of numbers or a texture; NaN, or out of the field's range.
    """
    span = RANGES[name]
    if isinstance(value, Texture):
        _check_bounds(value.image, span)
        return value
    if isinstance(value, list | tuple | np.ndarray) or (isinstance(value, Tensor) and value.ndim):
        do = "give one number, one per triangle, or a Texture"
        row = checked_tensor(value, (None,), span.what, do)
        if not len(row):
            raise InputError(f"expected {span.what} of some triangles, got none; {do}")
        _check_bounds(row, span)
        return row
    _check_number(value, span)
    return value  # type: ignore[return-value]


def _check_bounds(numbers: Tensor, span: ValueRange) -> None:
    for end in (numbers.detach().min(), numbers.detach().max()):
        _check_number(end, span)


def _check_number(number: object, span: ValueRange) -> None:
    checked_number(number, span.what, span.low, min(span.high, _MAX_VALUE), open_low=span.open_low)


def evaluate_value(value: Value) -> Float64[Tensor, "*row"]:
    """Return the value as a tensor: 0-d, or one number per triangle."""
    if isinstance(value, Texture):
        return value.values
    return torch.as_tensor(value, dtype=torch.float64)


def row_count(values: Mapping[str, object]) -> int | None:
    """Count the triangles of values; None if they hold for a whole object.

    Raises:
        InputError: values for different numbers of triangles.
    """
    counts = {}
    for name, value in values.items():
        if isinstance(value, Texture):
            counts[name] = len(value.uv)
        elif isinstance(value, Tensor) and value.ndim:
            counts[name] = len(value)
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"{name} for {count}" for name, count in counts.items())
        raise InputError(
            f"expected values for the same triangles, got {listed}; give one number per triangle"
        )
    return next(iter(counts.values()), None)
