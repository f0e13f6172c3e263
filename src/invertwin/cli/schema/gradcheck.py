"""The table of gradient checks."""

from typing import Annotated, Any, Literal

from pydantic import model_validator

from invertwin.cli.registry import OneOf
from invertwin.cli.section import Depth, Section, check_presence, key
from invertwin.limits import Count, Positive


class Gradcheck(Section):
    """Derivative of the map against central differences."""

    parameter: Annotated[Any, OneOf("theta")] = key("the scalar θ; θ = 0 is the scene as written")
    step: Positive | None = key(
        "of the differences: m, relative for scale and density, standard deviations for latent",
        None,
    )
    step_deg: Positive | None = key("the same for rotations and joints", None)
    noise: Positive = key("‖standard error‖₁/‖g_FD‖₁ at which repeating stops", 0.007)
    max_pairs: Count = key("of differences, at most", 64)
    depth: Depth = key("most bounces of a path", 3)
    samples: Count = key("rays of one derivative", 4_000_000)
    boundary_samples: Count = key("silhouette samples of one derivative", 1_000_000)
    repeats: Count = key("derivatives averaged", 4)
    difference_samples: Count = key("samples of one end of a pair", 8_000_000)
    sampling: Literal["rays", "area"] = key("of the differences", "rays")

    @model_validator(mode="after")
    def _complete(self) -> "Gradcheck":
        turns = self.parameter.kind.endswith("rotation") or self.parameter.kind == "joint"
        wanted = {"step_deg": turns, "step": not turns}
        check_presence(self, wanted, f"with kind = {self.parameter.kind}")
        return self
