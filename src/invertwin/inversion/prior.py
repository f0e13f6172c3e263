"""A regulariser that keeps a latent likely under its prior of shapes."""

from jaxtyping import Float64
from torch import Tensor, nn

from invertwin.errors import InputError
from invertwin.scene.scene import Scene


class LatentNorm:
    """The term ½ weight |z|²: the negative logarithm of a latent's prior probability."""

    def __init__(self, module: nn.Module, weight: float) -> None:
        """Regularise the parameter `latent` of a module, such as `PriorShape` or `LinearShape`.

        Args:
            module: It has the latent.
            weight: Factor of ½ |z|².
        """
        if not isinstance(getattr(module, "latent", None), nn.Parameter):
            raise InputError(
                f"expected a module with a latent, got {type(module).__name__}; "
                "give a PriorShape or a LinearShape"
            )
        self.module, self.weight = module, weight

    def __call__(self, scene: Scene) -> Float64[Tensor, ""]:
        """The term at the module's present latent."""
        return 0.5 * self.weight * self.module.latent.square().sum()  # type: ignore[union-attr]
