"""The table of a start that conventional processing finds."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from invertwin.cli.schema.section import Positive, Section, Vector, check_presence


class Initial(Section):
    """Where an object stands by conventional processing: the fit starts there, not where the
    scene has it."""

    object: str
    """name in the scene"""
    low: Vector | None = None
    """m, corner of the box of the world that is searched; needed unless the pose is known"""
    high: Vector | None = None
    """m, its opposite corner"""
    method: Literal["points", "image"] = "points"
    """points = of a CFAR detector; image = backprojected power"""
    pose: Literal["rectangle", "axes", "position", "known"] = "rectangle"
    """how it stands: the near sides of a rectangle, principal axes, no turn, or as the scene says:
    then its density alone is guessed"""
    scale: bool = False
    """size from the rectangle, too"""
    up: Literal["y", "z"] = "y"
    """world axis of heights"""
    false_alarm: Annotated[float, Field(gt=0, lt=1)] = 1e-6
    """of a cell of noise, for points"""
    step: Positive = 0.1
    """m, of the image"""
    gap: Positive = 1.0
    """m; echoes with wider gaps between them are not of one object"""

    @model_validator(mode="after")
    def _complete(self) -> "Initial":
        needed = self.pose != "known"
        check_presence(self, {"low": needed, "high": needed}, f'with pose = "{self.pose}"')
        return self
