"""The table of gradient checks."""

from typing import Annotated, Literal

from annotated_types import Ge
from pydantic import model_validator

from invertwin.cli.materials import MaterialValue
from invertwin.cli.section import Counts, Depth, Section, Vector, check_presence, key
from invertwin.limits import Count, Positive


class GradientParameter(Section):
    """The scalar θ of a gradient check; θ = 0 is the scene as written."""

    kind: Literal[
        "translation",
        "rotation",
        "scale",
        "material",
        "radar_translation",
        "radar_rotation",
        "joint",
        "latent",
        "distance",
        "density",
    ] = key(
        "joint = turns one of a body; latent = a coordinate of a vehicle or prior; distance = "
        "moves the surface of a signed distance outwards, density = thickens a cloud in the "
        "object's place, both in a round bump"
    )
    object: str | None = key("name in the scene; none for the radar's", None)
    axis: Vector | None = key("direction, or axis of the turn", None)
    value: MaterialValue | None = key("for kind material", None)
    joint: str | None = key("name, for kind joint", None)
    index: Annotated[int, Ge(0)] | None = key("from 0, for kind latent", None)
    center: Vector | None = key("of the bump, in the object's frame [m]", None)
    width: Positive | None = key("standard deviation of the bump [m]", None)
    low: Vector | None = key(
        "corner of the nodes of distance or density, in the object's frame [m]", None
    )
    high: Vector | None = key("the opposite corner [m]", None)
    counts: Counts | None = key("nodes along x, y and z", None)
    extinction: Positive | None = key("of the cloud [1/m], for kind density", None)

    @model_validator(mode="after")
    def _complete(self) -> "GradientParameter":
        grid = self.kind in ("distance", "density")
        wanted = {
            "object": not self.kind.startswith("radar"),
            "axis": self.kind.endswith(("translation", "rotation")) or self.kind == "joint",
            "value": self.kind == "material",
            "joint": self.kind == "joint",
            "index": self.kind == "latent",
            **dict.fromkeys(("center", "width", "low", "high", "counts"), grid),
            "extinction": self.kind == "density",
        }
        check_presence(self, wanted, f"with kind = {self.kind}")
        return self


class Gradcheck(Section):
    """Derivative of the map against central differences."""

    parameter: GradientParameter = key("the scalar θ")
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
