"""Lines through the parameters of a module: paths of gradient checks and loss landscapes."""

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn

from invertwin.channel import Sampling
from invertwin.deprecation import rename_members
from invertwin.errors import InputError
from invertwin.inversion.forward_mode import Evaluation
from invertwin.inversion.gradcheck.tangents import ParameterChanges, parameter_changes
from invertwin.inversion.loss import resolve_loss
from invertwin.inversion.observation import Observation
from invertwin.scene.mesh import Mesh

_NEWTON_STEPS = 8  # steps along a normal to the zero of the changed field
_SURFACE_TOLERANCE = 1e-9  # residual distance to that zero [m]


class ParameterLine:
    """Parameters of a module, displaced by θ times a tangent."""

    def __init__(self, module: nn.Module, tangent: ParameterChanges, target: Any) -> None:
        """Define the line.

        Args:
            module: module that maps the target.
            tangent: changes of its values by name, see ``parameter_changes``.
            target: scene or sensor that the module maps.

        Raises:
            InputError: A name or a shape that the module does not have.
        """
        self._module, self._target = module, target
        self._tangent = parameter_changes(module, tangent)
        self._start = {name: value.detach() for name, value in module.named_parameters()}

    def evaluate(self, theta: Tensor) -> Any:
        """Return the module's result at a scalar θ, which may carry a derivative."""
        moved = {n: self._start[n] + theta * change for n, change in self._tangent.items()}
        return torch.func.functional_call(self._module, self._start | moved, (self._target,))

    def evaluate_end(self, theta: float) -> Any:
        """Return the module's result at θ, one end of a difference."""
        return self.evaluate(torch.tensor(theta, dtype=torch.float64))


class DistanceFieldLine(ParameterLine):
    """Line of a signed distance whose differences keep the triangles of θ = 0.

    Differences with common random numbers require fixed triangles, so the ends are not remeshed:
    the vertices of the first mesh follow the zero of the changed field along their normals.
    Derivatives pass through the module, its marching cubes included.
    """

    def __init__(self, module: nn.Module, tangent: ParameterChanges, target: Any) -> None:
        """Define the line of a module with an ``object`` and a ``distance`` method."""
        super().__init__(module, tangent, target)
        self._object = str(module.object)
        with torch.no_grad():
            self._scene = module(target)
        self._mesh = self._scene[self._object].mesh
        _, slope = self._distance_and_gradient(0.0, self._mesh.vertices.detach())
        self._normals = slope / slope.norm(dim=1, keepdim=True)

    def evaluate_end(self, theta: float) -> Any:
        """Return the scene with the first mesh moved onto the changed surface."""
        positions = self._mesh.vertices.detach()
        for _ in range(_NEWTON_STEPS):
            found, slope = self._distance_and_gradient(theta, positions)
            distance = found / (slope * self._normals).sum(1)
            positions = positions - self._normals * distance[:, None]
        found, _ = self._distance_and_gradient(theta, positions)
        if not bool(found.abs().max() < _SURFACE_TOLERANCE):
            raise InputError(
                "expected a surface that follows θ along its normals, got points that do not meet "
                f"it at θ = {theta:.3g}; take a smaller step"
            )
        return self._scene.replace(self._object, mesh=Mesh(positions, self._mesh.faces))

    def _distance_and_gradient(self, theta: float, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Return the changed distance at points, and its spatial gradient."""
        at = positions.detach().requires_grad_()
        moved = {f"module.{n}": self._start[n] + theta * by for n, by in self._tangent.items()}
        evaluation = Evaluation(self._module, lambda: self._module.distance(at))  # type: ignore[operator]
        with torch.enable_grad():
            found = torch.func.functional_call(evaluation, moved, ())
            (slope,) = torch.autograd.grad(found.sum(), at)
        return found.detach(), slope


def make_line(module: nn.Module, tangent: ParameterChanges | Tensor, target: Any) -> ParameterLine:
    """Return the line of a module's parameters along a tangent.

    Args:
        module: module that maps the target.
        tangent: changes of its values by name, see ``parameter_changes``, or of its only parameter.
        target: scene or sensor that the module maps.

    Raises:
        InputError: A tangent that does not fit the module's parameters.
    """
    if isinstance(tangent, Tensor):
        names = [name for name, _ in module.named_parameters()]
        if len(names) != 1:
            raise InputError(
                f"expected changes by name for {type(module).__name__} ({', '.join(names)}), got "
                "a tensor; give a dict"
            )
        tangent = {names[0]: tangent}
    meshed_anew = hasattr(module, "distance") and hasattr(module, "object")
    return (DistanceFieldLine if meshed_anew else ParameterLine)(module, tangent, target)


def evaluate_losses(
    line: ParameterLine, offsets: Iterable[float], observation: Observation, *, seed: int = 0
) -> Tensor:
    """Evaluate the loss of one observation along a line of scenes: its loss landscape.

    All scenes share the random numbers of the start of the line: the same points on surfaces, and
    the same rough points of coherent models.

    Args:
        line: line of a module that maps the scene, see ``make_line``.
        offsets: θ of each scene.
        observation: the observation. Its loss may return several numbers; None = the default of
            ``reconstruct``.
        seed: seed of all random numbers.

    Returns:
        Losses [offset] or [offset, number].
    """
    sensor, loss = observation.sensor, resolve_loss(observation.model, observation.loss)
    with torch.no_grad():
        observed, start = observation.observed_map(), line.evaluate_end(0.0)
        observed = observation.model.blur_observed(observed, sensor)
        model = observation.model.prepare(start, sensor, seed)
        samples = getattr(model, "sampling", Sampling()).samples
        model = model.for_differences(start, sensor, samples, "area")
        maps = (model.predict(line.evaluate_end(float(offset)), sensor, seed) for offset in offsets)
        return torch.stack([loss(predicted, observed) for predicted in maps])


rename_members(ParameterLine, at="evaluate", end="evaluate_end")
