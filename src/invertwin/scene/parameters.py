"""Differentiable parameters: modules Scene → Scene and their composition.

Every module is initially the identity unless initial values are given, and composes with the
others. Any torch module Scene → Scene may be used as well.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, TypeVar

import torch
from annotated_types import Ge, MinLen
from jaxtyping import Float64
from torch import Tensor, nn

from invertwin.checks import ArrayLike, checked_count, checked_number, checked_point, checked_tensor
from invertwin.deprecation import rename_members
from invertwin.errors import InputError
from invertwin.limits import MAX_LENGTH, Axes
from invertwin.scene import pose
from invertwin.scene.material.itu import Itu
from invertwin.scene.material.materials import select_layer
from invertwin.scene.material.values import RANGES, MaterialValue, Texture, Value, checked_value
from invertwin.scene.mesh import Mesh
from invertwin.scene.scene import Object, Scene

ORIGIN = (0.0, 0.0, 0.0)
# Relevant errors of a position [m] and of a rotation [rad].
_POSITION_SCALE, _ROTATION_SCALE = 0.1, 0.2
_T = TypeVar("_T")


@dataclass(frozen=True)
class Entries:
    """Named entries of a module's parameter.

    A module lists them in ``entries()``, by name. Tangents of gradient checks may use the name.

    Attributes:
        parameter: name of the parameter.
        index: index of its entries.
        slope: derivative of the named value with respect to them.
    """

    parameter: str
    index: Any = ...
    slope: float | Tensor = 1.0


@dataclass(frozen=True)
class Coordinate:
    """Scalar result of a fit in natural units.

    A module lists them in ``coordinates()``; for others every entry of a parameter is one.

    Attributes:
        name: name, such as "letter.x".
        unit: SI unit, or empty.
        tangents: derivatives of the module's parameters with respect to it, by name.
        span: relevant error; infinite if unknown.
    """

    name: str
    unit: str
    tangents: Mapping[str, Tensor]
    span: float = math.inf


class ObjectModule(nn.Module):
    """Module Scene → Scene that changes one object, by default its mesh.

    Attributes:
        object: name of the object.
        reported: names of the attributes that `values` returns.
    """

    reported: tuple[str, ...] = ()

    def __init__(self, object: str) -> None:
        super().__init__()
        self.object = object

    def update_mesh(self, mesh: Mesh) -> Mesh:
        """Return the object's new mesh, given its present one."""
        raise NotImplementedError

    def forward(self, scene: Scene) -> Scene:
        """Return the scene with the object's mesh replaced."""
        return scene.replace(self.object, mesh=self.update_mesh(scene[self.object].mesh))

    def values(self) -> dict[str, Tensor]:
        """Return the fitted values by name in SI units, for progress and reports."""
        return {f"{self.object}.{n}": getattr(self, n).detach().clone() for n in self.reported}


class Translation(ObjectModule):
    """Translate an object along the world axes.

    Args:
        object: name of the object.
        initial: initial translation [m].
        axes: free world axes; the others keep their values.

    Attributes:
        translation: parameter [3], metres.

    Raises:
        InputError: `initial` is not three finite numbers, or an unknown axis.
    """

    reported = ("translation",)

    def __init__(self, object: str, initial: ArrayLike = ORIGIN, axes: Axes = "xyz") -> None:
        super().__init__(object)
        self.translation = nn.Parameter(_vector(initial, "initial translation [m]"))
        self._axes = axes_mask(axes)

    def forward(self, scene: Scene) -> Scene:
        """Return the scene with the object moved."""
        motion = pose.rigid(translation=free_part(self.translation, self._axes))
        return scene.replace(self.object, pose=pose.compose(scene[self.object].transform, motion))

    def coordinates(self) -> list[Coordinate]:
        """Return the free coordinates among x, y and z."""
        return position_coordinates(self.object, "translation", self._axes)


class RigidMotion(nn.Module):
    """Translation and rotation without singularities: quaternion ∝ (w, r/2).

    Args:
        translation: initial translation [m].
        rotation: rotation vector of any angle [3] (rad), or q itself [4].
        axes: free world axes of the translation.
        rotation_axes: free components of the rotation vector.

    Attributes:
        moved: name of what moves.
        translation: parameter [3], metres.
        rotation: parameter [4], q = (w, r) with the quaternion ∝ (w, r/2); near the identity (1, 0,
            0, 0), r is the rotation vector in world axes [rad]. Any q but zero is a rotation, and
            its derivative is finite everywhere.

    Raises:
        InputError: wrong shapes, NaN, q = 0, or an unknown axis.
    """

    moved: str

    def __init__(
        self,
        translation: ArrayLike = ORIGIN,
        rotation: ArrayLike = ORIGIN,
        axes: Axes = "xyz",
        rotation_axes: Axes = "xyz",
    ) -> None:
        super().__init__()
        self.translation = nn.Parameter(_vector(translation, "initial translation [m]"))
        self.rotation = nn.Parameter(_rotation_numbers(rotation))
        self._axes = axes_mask(axes)
        self._rotation_axes = torch.cat([torch.ones(1), axes_mask(rotation_axes)])

    @property
    def rotation_matrix(self) -> Float64[Tensor, "3 3"]:
        """Return the rotation as a matrix."""
        return pose.rotation_from_quaternion(self._quaternion)

    @property
    def shift(self) -> Float64[Tensor, "3"]:
        """Return the translation [m], with a derivative along the free axes."""
        return free_part(self.translation, self._axes)

    @property
    def _quaternion(self) -> Tensor:
        # Halving r makes (1, r) the rotation vector r [rad] to first order: one rate suits all.
        halves = self.rotation.new_tensor([1.0, 0.5, 0.5, 0.5])
        return free_part(self.rotation, self._rotation_axes) * halves

    def entries(self) -> dict[str, Entries]:
        """Return the rotation vector [rad], to first order about the identity."""
        return {"rotation": Entries("rotation", slice(1, None))}

    def coordinates(self) -> list[Coordinate]:
        """Return x, y, z and the rotations about these world axes: roll, pitch, yaw [rad]."""
        found = position_coordinates(self.moved, "translation", self._axes)
        free = self._rotation_axes[1:]
        w, r = self.rotation.detach()[0], self.rotation.detach()[1:]
        for turn, axis in zip(("roll", "pitch", "yaw"), torch.eye(3, dtype=r.dtype), strict=True):
            if axis @ free:
                # The product of the quaternion (1, axis/2) and the present one (w, r/2).
                change = torch.cat([-axis @ r[:, None] / 4, w * axis + axis.cross(r, 0) / 2])
                tangents = {"rotation": change * self._rotation_axes}
                found.append(Coordinate(f"{self.moved}.{turn}", "rad", tangents, _ROTATION_SCALE))
        return found

    def values(self) -> dict[str, Tensor]:
        """Return translation [m] and rotation vector [rad] by name, for progress and reports."""
        return {
            f"{self.moved}.translation": self.translation.detach().clone(),
            f"{self.moved}.rotation": pose.vector_from_quaternion(self._quaternion.detach()),
        }


class Pose(RigidMotion):
    """Rotate an object about its centre, then translate it along the world axes.

    Args:
        object: name of the object. The other arguments are those of `RigidMotion`.
    """

    def __init__(
        self,
        object: str,
        translation: ArrayLike = ORIGIN,
        rotation: ArrayLike = ORIGIN,
        axes: Axes = "xyz",
        rotation_axes: Axes = "xyz",
    ) -> None:
        super().__init__(translation, rotation, axes, rotation_axes)
        self.object = self.moved = object

    def forward(self, scene: Scene) -> Scene:
        """Return the scene with the object moved."""
        before = scene[self.object]
        rotation, center = self.rotation_matrix, before.center
        motion = pose.rigid(rotation, self.shift + center - rotation @ center)
        return scene.replace(self.object, pose=pose.compose(before.transform, motion))


class Scale(ObjectModule):
    """Scale an object about its centre.

    Args:
        object: name of the object.
        initial: initial factor.

    Attributes:
        log_scale: parameter, natural logarithm of the factor.

    Raises:
        InputError: `initial` is not positive.
    """

    reported = ("scale",)

    def __init__(self, object: str, initial: float = 1.0) -> None:
        super().__init__(object)
        factor = checked_number(initial, "initial scale", 0.0, open_low=True)
        self.log_scale = nn.Parameter(torch.tensor(math.log(factor), dtype=torch.float64))

    @property
    def scale(self) -> Float64[Tensor, ""]:
        """Scale factor."""
        return self.log_scale.exp()

    def update_mesh(self, mesh: Mesh) -> Mesh:
        """Return the scaled mesh."""
        return Mesh(mesh.center + (mesh.vertices - mesh.center) * self.scale, mesh.faces)

    def coordinates(self) -> list[Coordinate]:
        """Return the scale factor."""
        return [Coordinate(f"{self.object}.scale", "", {"log_scale": 1 / self.scale.detach()}, 0.2)]


class Vertices(ObjectModule):
    """Displace every vertex of an object freely.

    Args:
        object: name of the object.
        count: number of its vertices.

    Attributes:
        offsets: parameter [v, 3] in the object's frame, metres.

    Raises:
        InputError: no vertices.
    """

    reported = ("offsets",)

    def __init__(self, object: str, count: int) -> None:
        super().__init__(object)
        rows = checked_count(count, "number of vertices", 1)
        self.offsets = nn.Parameter(torch.zeros(rows, 3, dtype=torch.float64))

    def update_mesh(self, mesh: Mesh) -> Mesh:
        """Return the mesh with its vertices displaced.

        Raises:
            InputError: another number of vertices.
        """
        if mesh.vertices.shape != self.offsets.shape:
            raise InputError(
                f"expected {len(self.offsets)} vertices in {self.object!r}, "
                f"got {len(mesh.vertices)}; create Vertices with the mesh's count"
            )
        return Mesh(mesh.vertices + self.offsets, mesh.faces)


class MaterialValues(nn.Module):
    """Replace values of an object's material, within their physical range.

    A scalar initial value is fitted as a scalar, a value per triangle or a `Texture` per triangle
    or per pixel.

    Args:
        object: name of the object.
        layer: index of the layer of a `Multilayer`; None for values of the material itself.
        start: initial values by the names of `RANGES`, strictly inside their ranges: permittivity,
            conductivity [S/m], loss_tangent, permeability, magnetic_loss_tangent, thickness [m],
            diffuse, lobe_width [rad], scattering, rms_slope, lambertian, directive,
            directive_exponent, backscatter_exponent, rms_height [m], depolarisation.

    Attributes:
        raw: unbounded parameters by field: for one-sided ranges, such as the permittivity, the
            logarithm of the excess; for two-sided ranges the logit of the relative position.

    Raises:
        InputError: none given, an unknown name, or a value at or beyond the end of its range.
    """

    def __init__(self, object: str, *, layer: int | None = None, **start: Value | None) -> None:
        super().__init__()
        self.object = object
        self.layer = None if layer is None else checked_count(layer, "number of a layer", 0)
        given = {name: value for name, value in start.items() if value is not None}
        unknown = [name for name in given if name not in RANGES]
        if unknown or not given:
            got = ", ".join(unknown) or "none"
            raise InputError(f"expected at least one of {', '.join(RANGES)}, got {got}; give one")
        self.raw = nn.ParameterDict()
        self._textures: dict[str, Texture] = {}
        for name, value in given.items():
            checked = checked_value(value, name)
            if isinstance(checked, Texture):
                self._textures[name] = checked
                checked = checked.image
            first = torch.as_tensor(checked, dtype=torch.float64).detach()
            self.raw[name] = nn.Parameter(_to_unbounded(name, first))

    @classmethod
    def from_object(
        cls,
        object: str,
        values: Annotated[Sequence[MaterialValue], MinLen(1)],
        item: Object,
        layer: Annotated[int, Ge(0)] | None = None,
    ) -> "MaterialValues":
        """Start from the material values of an object.

        Args:
            object: name of the object.
            values: names of the fitted values.
            item: the object.
            layer: index of the layer of a multilayer, from 0.

        Raises:
            InputError: the material has no such value or layer, a value comes from the ITU table,
                or it is at the end of its range.
        """
        try:
            holder = select_layer(item.material, layer, type(item.material).__name__)
            start = {name: _initial_value(holder, name) for name in values}
            return cls(object, layer=layer, **start)
        except InputError as error:
            raise InputError(str(error), f"values, material of {object}") from None

    def forward(self, scene: Scene) -> Scene:
        """Return the scene with the material's values replaced.

        Raises:
            InputError: the object's material has no such value, or no such layer.
        """
        material: Any = scene[self.object].material
        holder = select_layer(material, self.layer, repr(self.object))
        where = "material" if self.layer is None else "layer"
        if any(name not in getattr(holder, "__dataclass_fields__", {}) for name in self.raw):
            raise InputError(
                f"expected a {where} with {', '.join(self.raw)} for {self.object!r}, got "
                f"{type(holder).__name__}; give it another material"
            )
        values = {name: _to_bounded(name, raw) for name, raw in self.raw.items()}
        images = {n: replace(t, image=values[n]) for n, t in self._textures.items()}
        changed = replace(holder, **(values | images))
        if self.layer is not None:
            layers = [*material.layers]
            layers[self.layer] = changed
            changed = replace(material, layers=layers)
        return scene.replace(self.object, material=changed)

    def values(self) -> dict[str, Tensor]:
        """Return material values in their own units by name, for progress and reports.

        A texture is returned as its image.
        """
        where = self.object if self.layer is None else f"{self.object}.layers[{self.layer}]"
        return {
            f"{where}.{name}": _to_bounded(name, raw).detach() for name, raw in self.raw.items()
        }

    def entries(self) -> dict[str, Entries]:
        """Return the values in their own units."""
        slopes = {name: _bounded_slope(name, raw.detach()) for name, raw in self.raw.items()}
        return {name: Entries(f"raw.{name}", slope=slope) for name, slope in slopes.items()}

    def at_bounds(self) -> list[str]:
        """Return the names of values close to an end of their range."""
        places = {name: _bounded_slope(name, raw.detach()) for name, raw in self.raw.items()}
        spans = {name: RANGES[name].high - RANGES[name].low for name in places}
        near = {n: 1e-4 if math.isinf(span) else 0.01 * span for n, span in spans.items()}
        return [f"{self.object}.{n}" for n, p in places.items() if bool((p < near[n]).any())]


class Compose(nn.Module):
    """Apply several modules of one kind, from first to last.

    All modules map scenes, or all map radars.
    """

    def __init__(self, *modules: nn.Module) -> None:
        super().__init__()
        self.parts = nn.ModuleList(modules)

    def forward(self, target: _T) -> _T:
        """Return the scene, or the radar, after all modules."""
        for part in self.parts:
            target = part(target)
        return target

    def values(self) -> dict[str, Tensor]:
        """Return the values of all modules by name, for progress and reports."""
        named = [getattr(part, "values", dict)() for part in self.parts]
        return {name: value for own in named for name, value in own.items()}


def _initial_value(holder: Any, name: str) -> Value:
    """Return the initial value of a material or a layer."""
    if not hasattr(holder, name):
        raise InputError(f"expected values of {type(holder).__name__}, got {name}; remove it")
    value = getattr(holder, name)
    if isinstance(value, Itu):
        raise InputError(
            f"expected a number from which {name} starts, got that of the ITU table; "
            f"give `{name}` beside `itu`"
        )
    return value


def _to_bounded(name: str, raw: Tensor) -> Tensor:
    """Map an unbounded parameter to the range of a value."""
    span = RANGES[name]
    if math.isinf(span.high):
        return span.low + raw.exp()
    return span.low + (span.high - span.low) * torch.sigmoid(raw)


def _bounded_slope(name: str, raw: Tensor) -> Tensor:
    """Return the derivative of `_to_bounded` with respect to the parameter."""
    span = RANGES[name]
    if math.isinf(span.high):
        return raw.exp()
    place = torch.sigmoid(raw)
    return (span.high - span.low) * place * (1 - place)


def _to_unbounded(name: str, value: Tensor) -> Tensor:
    """Map a value to the unbounded parameter, the inverse of `_to_bounded`."""
    span = RANGES[name]
    ends = (value == span.low) | (value == span.high)
    if bool(ends.any()):
        raise InputError(
            f"expected an initial {name} inside ({span.low:g}, {span.high:g}), "
            f"got {float(value[ends].flatten()[0]):g}; "
            "start away from the end of the range, where the gradient vanishes"
        )
    above = value - span.low
    return above.log() if math.isinf(span.high) else torch.logit(above / (span.high - span.low))


def position_coordinates(name: str, parameter: str, mask: Tensor) -> list[Coordinate]:
    """The free coordinates of a position [m].

    Args:
        name: name of the object or antenna at the position.
        parameter: name of the parameter [2 or 3] that moves it.
        mask: 1 for each free axis.
    """
    return [
        Coordinate(f"{name}.{axis}", "m", {parameter: along}, _POSITION_SCALE)
        for axis, along, free in zip("xyz", torch.diag(mask), mask, strict=False)
        if free
    ]


def axes_mask(axes: str) -> Tensor:
    """Return 1 for the named axes, 0 for the others.

    Raises:
        InputError: an unknown axis.
    """
    if set(axes) - set("xyz"):
        raise InputError(f"expected axes among x, y and z, got {axes!r}; write them as 'xy'")
    return torch.tensor([float(axis in axes) for axis in "xyz"], dtype=torch.float64)


def free_part(parameter: Tensor, mask: Tensor) -> Tensor:
    """Return the parameter without derivatives of its fixed entries.

    Args:
        parameter: values [*].
        mask: 1 for free entries, 0 for fixed ones.
    """
    return parameter * mask + parameter.detach() * (1 - mask)


def _vector(value: ArrayLike, what: str) -> Tensor:
    # A copy, since the optimiser changes the parameter in place.
    return checked_point(value, what, most=MAX_LENGTH).detach().clone()


def _rotation_numbers(value: ArrayLike) -> Tensor:
    do = "give a rotation vector [3] in rad or q = (w, rx, ry, rz)"
    numbers = checked_tensor(value, (None,), "initial rotation", do)
    if len(numbers) == 3:
        quaternion = pose.quaternion_from_vector(numbers.detach())
        return quaternion * quaternion.new_tensor([1.0, 2.0, 2.0, 2.0])
    if len(numbers) != 4 or not bool(numbers.any()):
        raise InputError(
            "expected an initial rotation of 3 numbers, or 4 that are not all zero, "
            f"got {numbers.tolist()}; {do}"
        )
    return numbers.detach().clone()


rename_members(ObjectModule, reshaped="update_mesh")
