"""What can be fitted: modules that map a scene to a scene, or a radar to a radar.

Every module starts as the identity unless initial values are given, and composes with the others.
`applies_to` says what a module maps; any torch module Scene → Scene without it serves as well.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float64
from torch import Tensor, nn

from invertwin.errors import InputError
from invertwin.scene.checks import ArrayLike, checked_count, checked_number, checked_tensor
from invertwin.scene.mesh import Mesh
from invertwin.scene.pose import (
    compose,
    quaternion_from_vector,
    rigid,
    rotation_from_quaternion,
    vector_from_quaternion,
)
from invertwin.scene.scene import Scene

ORIGIN = (0.0, 0.0, 0.0)


class Translation(nn.Module):
    """Moves an object along the world axes.

    Attributes:
        translation: parameter [3], metres.
    """

    applies_to = "scene"

    def __init__(self, object: str, initial: ArrayLike = ORIGIN, axes: str = "xyz") -> None:
        """Move `object`, by `initial` [m] at the start.

        Args:
            object: name of the object.
            initial: [m].
            axes: world axes along which the fit may move it; the others keep their values.

        Raises:
            InputError: `initial` is not three finite numbers, or an unknown axis.
        """
        super().__init__()
        self.object = object
        self.translation = nn.Parameter(_vector(initial, "initial translation [m]"))
        self._axes = _checked_axes(axes)

    def forward(self, scene: Scene) -> Scene:
        """The scene with the object moved."""
        motion = rigid(translation=_sought(self.translation, self._axes))
        return scene.replace(self.object, pose=compose(scene[self.object].transform, motion))

    def values(self) -> dict[str, Tensor]:
        """Translation [m] by name, for progress and reports."""
        return {f"{self.object}.translation": self.translation.detach().clone()}


class _Motion(nn.Module):
    """A translation and a rotation without singularities: quaternion ∝ (w, r/2)."""

    def __init__(
        self, translation: ArrayLike, rotation: ArrayLike, axes: str, rotation_axes: str
    ) -> None:
        super().__init__()
        self.translation = nn.Parameter(_vector(translation, "initial translation [m]"))
        self.rotation = nn.Parameter(_rotation_numbers(rotation))
        self._axes, self._rotation_axes = _checked_axes(axes), _checked_axes(rotation_axes)

    @property
    def rotation_matrix(self) -> Float64[Tensor, "3 3"]:
        """The rotation as a matrix."""
        return rotation_from_quaternion(self._quaternion)

    @property
    def shift(self) -> Float64[Tensor, "3"]:
        """The translation [m], with a derivative along the axes that are sought."""
        return _sought(self.translation, self._axes)

    @property
    def _quaternion(self) -> Tensor:
        # Halving r makes (1, r) the rotation vector r [rad] to first order, so that one learning
        # rate in rad serves all components.
        halves = self.rotation.new_tensor([1.0, 0.5, 0.5, 0.5])
        return _sought(self.rotation, self._rotation_axes) * halves

    def _named_values(self, name: str) -> dict[str, Tensor]:
        return {
            f"{name}.translation": self.translation.detach().clone(),
            f"{name}.rotation": vector_from_quaternion(self._quaternion.detach()),
        }


class Pose(_Motion):
    """Turns an object about its centre, then moves it along the world axes.

    Attributes:
        translation: parameter [3], metres.
        rotation: parameter [4], q = (w, r) with the quaternion ∝ (w, r/2); near the identity
            (1, 0, 0, 0), r is the rotation vector in the world [rad]. Any q but zero is a
            rotation, and its derivative is finite everywhere.
    """

    applies_to = "scene"

    def __init__(
        self,
        object: str,
        translation: ArrayLike = ORIGIN,
        rotation: ArrayLike = ORIGIN,
        axes: str = "xyz",
        rotation_axes: str = "xyz",
    ) -> None:
        """Move `object`, from these values at the start.

        Args:
            object: name of the object.
            translation: [m].
            rotation: rotation vector of any angle [3] (rad), or q itself [4].
            axes: world axes along which the fit may move it.
            rotation_axes: components of the rotation vector that the fit may change.

        Raises:
            InputError: wrong shapes, NaN, q = 0, or an unknown axis.
        """
        super().__init__(translation, rotation, axes, rotation_axes)
        self.object = object

    def forward(self, scene: Scene) -> Scene:
        """The scene with the object moved."""
        before = scene[self.object]
        rotation, center = self.rotation_matrix, before.center
        motion = rigid(rotation, self.shift + center - rotation @ center)
        return scene.replace(self.object, pose=compose(before.transform, motion))

    def values(self) -> dict[str, Tensor]:
        """Translation [m] and rotation vector [rad] by name, for progress and reports."""
        return self._named_values(self.object)


class Scale(nn.Module):
    """Scales an object about its centre.

    Attributes:
        log_scale: parameter, natural logarithm of the factor.
    """

    applies_to = "scene"

    def __init__(self, object: str, initial: float = 1.0) -> None:
        """Scale `object`, by the factor `initial` at the start.

        Raises:
            InputError: `initial` is not positive.
        """
        super().__init__()
        factor = checked_number(initial, "initial scale", 0.0, open_low=True)
        self.object = object
        self.log_scale = nn.Parameter(torch.tensor(math.log(factor), dtype=torch.float64))

    def forward(self, scene: Scene) -> Scene:
        """The scene with the object scaled."""
        mesh = scene[self.object].mesh
        vertices = mesh.center + (mesh.vertices - mesh.center) * self.log_scale.exp()
        return scene.replace(self.object, mesh=Mesh(vertices, mesh.faces))

    def values(self) -> dict[str, Tensor]:
        """Scale factor by name, for progress and reports."""
        return {f"{self.object}.scale": self.log_scale.detach().exp()}


class Vertices(nn.Module):
    """Moves every vertex of an object freely.

    Attributes:
        offsets: parameter [v, 3] in the object's frame, metres.
    """

    applies_to = "scene"

    def __init__(self, object: str, count: int) -> None:
        """Move the `count` vertices of `object`, by zero at the start.

        Raises:
            InputError: no vertices.
        """
        super().__init__()
        self.object = object
        rows = checked_count(count, "number of vertices", 1)
        self.offsets = nn.Parameter(torch.zeros(rows, 3, dtype=torch.float64))

    def forward(self, scene: Scene) -> Scene:
        """The scene with the vertices moved.

        Raises:
            InputError: the object has another number of vertices.
        """
        mesh = scene[self.object].mesh
        if mesh.vertices.shape != self.offsets.shape:
            raise InputError(
                f"expected {len(self.offsets)} vertices in {self.object!r}, "
                f"got {len(mesh.vertices)}; create Vertices with the mesh's count"
            )
        return scene.replace(self.object, mesh=Mesh(mesh.vertices + self.offsets, mesh.faces))

    def values(self) -> dict[str, Tensor]:
        """Vertex offsets [m] by name, for progress and reports."""
        return {f"{self.object}.offsets": self.offsets.detach().clone()}


class MaterialValues(nn.Module):
    """Replaces values of an object's material; they cannot leave their physical range.

    Attributes:
        raw: unbounded parameters by field: log(ε' − 1), log σ, logit of the diffuse fraction,
            logit of the lobe width over π.
    """

    applies_to = "scene"

    def __init__(
        self,
        object: str,
        *,
        permittivity: float | None = None,
        conductivity: float | None = None,
        diffuse: float | None = None,
        lobe_width: float | None = None,
    ) -> None:
        """Fit the given values of the material of `object`, from these values at the start.

        Args:
            object: name of the object.
            permittivity: relative permittivity > 1.
            conductivity: [S/m] > 0.
            diffuse: fraction between 0 and 1, both excluded.
            lobe_width: [rad] between 0 and π, both excluded.

        Raises:
            InputError: none given, or a value at or beyond the end of its range.
        """
        super().__init__()
        self.object = object
        given = {
            "permittivity": permittivity,
            "conductivity": conductivity,
            "diffuse": diffuse,
            "lobe_width": lobe_width,
        }
        self.raw = nn.ParameterDict(
            {
                name: nn.Parameter(_unbounded(name, value))
                for name, value in given.items()
                if value is not None
            }
        )
        if not self.raw:
            raise InputError(f"expected at least one of {', '.join(given)}, got none; give one")

    def forward(self, scene: Scene) -> Scene:
        """The scene with the material's values replaced.

        Raises:
            InputError: the object's material has no such value.
        """
        material: Any = scene[self.object].material
        fields = getattr(material, "__dataclass_fields__", {})
        missing = [name for name in self.raw if name not in fields]
        if missing:
            raise InputError(
                f"expected a material with {', '.join(missing)} for {self.object!r}, "
                f"got {type(material).__name__}; give the object another material"
            )
        return scene.replace(self.object, material=replace(material, **self._bounded()))

    def values(self) -> dict[str, Tensor]:
        """Material values in their own units by name, for progress and reports."""
        bounded = self._bounded()
        return {f"{self.object}.{name}": value.detach() for name, value in bounded.items()}

    def _bounded(self) -> dict[str, Tensor]:
        return {name: _BOUNDED[name](raw) for name, raw in self.raw.items()}


@runtime_checkable
class _Movable(Protocol):
    """What `RadarPose` needs of a radar; this room knows no more of it."""

    def moved(self, rotation: Tensor, translation: Tensor) -> Any: ...


class RadarPose(_Motion):
    """Turns and moves all poses of a radar together, as `radar.moved` defines it.

    Attributes:
        translation: parameter [3], metres.
        rotation: parameter [4], as in `Pose`.
    """

    applies_to = "radar"

    def __init__(
        self,
        translation: ArrayLike = ORIGIN,
        rotation: ArrayLike = ORIGIN,
        axes: str = "xyz",
        rotation_axes: str = "xyz",
    ) -> None:
        """Move the radar, from these values at the start.

        Args:
            translation: [m].
            rotation: rotation vector of any angle [3] (rad), or q itself [4].
            axes: world axes along which the fit may move it.
            rotation_axes: components of the rotation vector that the fit may change.

        Raises:
            InputError: wrong shapes, NaN, q = 0, or an unknown axis.
        """
        super().__init__(translation, rotation, axes, rotation_axes)

    def forward(self, radar: _Movable) -> Any:
        """The radar, moved."""
        return radar.moved(self.rotation_matrix, self.shift)

    def values(self) -> dict[str, Tensor]:
        """Translation [m] and rotation vector [rad] by name, for progress and reports."""
        return self._named_values("radar")


class Compose(nn.Module):
    """Several modules, applied from first to last.

    Called with a scene it applies those that map scenes, called with anything else those that map
    radars; what no module maps comes back unchanged.

    Attributes:
        applies_to: "scene", "radar", or "both".
    """

    def __init__(self, *modules: nn.Module) -> None:
        """Compose the given modules.

        Raises:
            InputError: a module that maps neither scenes nor radars, which would never be applied.
        """
        super().__init__()
        for module in modules:
            if _applies_to(module) not in ("scene", "radar", "both"):
                raise InputError(
                    "expected modules that map scenes or radars, "
                    f"got {type(module).__name__} for {_applies_to(module)}; pass it separately"
                )
        self.parts = nn.ModuleList(modules)

    @property
    def applies_to(self) -> str:
        """What the modules map: "scene", "radar", or "both"."""
        kinds = {_applies_to(part) for part in self.parts}
        return kinds.pop() if len(kinds) == 1 else "both"

    def forward(self, target: Any) -> Any:
        """The scene or the radar after all modules that map it."""
        kind = "scene" if isinstance(target, Scene) else "radar"
        for part in self.parts:
            if _applies_to(part) in (kind, "both"):
                target = part(target)
        return target

    def values(self) -> dict[str, Tensor]:
        """Values of all modules by name, for progress and reports."""
        merged: dict[str, Tensor] = {}
        for part in self.parts:
            values: Callable[[], dict[str, Tensor]] | None = getattr(part, "values", None)
            if values is not None:
                merged.update(values())
        return merged


_BOUNDED: dict[str, Callable[[Tensor], Tensor]] = {
    "permittivity": lambda raw: 1 + raw.exp(),
    "conductivity": torch.exp,
    "diffuse": torch.sigmoid,
    "lobe_width": lambda raw: math.pi * torch.sigmoid(raw),
}

_LIMITS = {
    "permittivity": (1.0, math.inf),
    "conductivity": (0.0, math.inf),
    "diffuse": (0.0, 1.0),
    "lobe_width": (0.0, math.pi),
}


def _unbounded(name: str, value: float) -> Tensor:
    """The parameter that `_BOUNDED` maps to `value`."""
    low, high = _LIMITS[name]
    number = checked_number(value, f"initial {name}", low, high)
    if number in (low, high):
        raise InputError(
            f"expected an initial {name} inside ({low:g}, {high:g}), got {number:g}; "
            "start away from the end of the range, where the gradient vanishes"
        )
    above = torch.tensor(number - low, dtype=torch.float64)
    return above.log() if math.isinf(high) else torch.logit(above / (high - low))


def _applies_to(module: nn.Module) -> str:
    return getattr(module, "applies_to", "scene")


def _checked_axes(axes: str) -> str:
    if set(axes) - set("xyz"):
        raise InputError(f"expected axes among x, y and z, got {axes!r}; write them as 'xy'")
    return axes


def _sought(parameter: Tensor, axes: str) -> Tensor:
    """The parameter, with no derivative in its last three numbers along the other axes."""
    mask = torch.ones_like(parameter)
    mask[-3:] = torch.tensor([float(axis in axes) for axis in "xyz"])
    return parameter * mask + parameter.detach() * (1 - mask)


def _vector(value: ArrayLike, what: str) -> Tensor:
    # A copy: the optimiser changes the parameter in place, and the given values are not its own.
    return checked_tensor(value, (3,), what, "give x, y, z").detach().clone()


def _rotation_numbers(value: ArrayLike) -> Tensor:
    do = "give a rotation vector [3] in rad or q = (w, rx, ry, rz)"
    numbers = checked_tensor(value, (None,), "initial rotation", do)
    if len(numbers) == 3:
        quaternion = quaternion_from_vector(numbers.detach())
        return quaternion * quaternion.new_tensor([1.0, 2.0, 2.0, 2.0])
    if len(numbers) != 4 or not bool(numbers.any()):
        raise InputError(
            "expected an initial rotation of 3 numbers, or 4 that are not all zero, "
            f"got {numbers.tolist()}; {do}"
        )
    return numbers.detach().clone()
