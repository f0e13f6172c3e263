"""The table of gradient checks."""

import math
from typing import Annotated, Any, Literal

from pydantic import GetCoreSchemaHandler, model_validator

from invertwin.inversion import GaussianBump, GradcheckSettings
from invertwin.limits import Count, Positive
from invertwin.refusals import refusal_text
from invertwin.registry.kinds import ConstructorTable, OneOf, number_or_list, registry
from invertwin.registry.section import Depth, check_presence, raise_key_error


class _ParameterRate:
    """Annotates a key that says how fast a value changes with θ."""

    @classmethod
    def __get_pydantic_core_schema__(cls, _: Any, handler: GetCoreSchemaHandler) -> Any:
        bump = registry.constructor_table(GaussianBump, "Bump", checked=None)
        return handler.generate_schema(number_or_list(float, list[Any], bump))


class GradcheckTable(ConstructorTable):
    """Derivative of the map against central differences: `GradcheckSettings`, and what is
    checked.

    Attributes:
        parameter: what changes with θ, as in [[parameters]]; θ = 0 is its start
        tangent: how fast its values change with θ, by name: a number for all entries, a list, or a
            bump over the nodes of a grid
        step: step of θ in the differences
        step_deg: the same where θ turns something
        depth: most bounces of a path
        samples: rays of one derivative
        boundary_samples: silhouette samples of one derivative
    """

    parameter: Annotated[Any, OneOf("parameter", ConstructorTable)]
    tangent: dict[str, Annotated[Any, _ParameterRate]]
    step: Positive | None = None
    step_deg: Positive | None = None
    depth: Depth = 3
    samples: Count = 4_000_000
    boundary_samples: Count = 1_000_000

    @property
    def acts_on(self) -> Literal["scene", "sensor"]:
        """Quantity that θ changes."""
        moved = ("radar_pose", "radar_path", "camera_pose", "transmitter", "panel")
        return "sensor" if self.parameter.kind in moved else "scene"

    @property
    def changes_angle(self) -> bool:
        """True if θ is an angle."""
        return not {"rotation", "yaw"}.isdisjoint(self.tangent) or self.parameter.kind == "body"

    def build(self, given: Any = None, /, **more: Any) -> GradcheckSettings:
        """Build the settings of the check: steps and samples."""
        turn = {} if self.step_deg is None else {"step": math.radians(self.step_deg)}
        return super().build(given, **turn, **more)

    @model_validator(mode="after")
    def _require_step(self) -> "GradcheckTable":
        if self.parameter.kind == "mover":
            raise_key_error(refusal_text("gradcheck.mover_parameter"))
        wanted = {"step_deg": self.changes_angle, "step": not self.changes_angle}
        check_presence(self, wanted, f"with kind = {self.parameter.kind}")
        return self
