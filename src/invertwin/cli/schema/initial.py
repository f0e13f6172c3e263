"""The table of a start that conventional processing finds."""

from typing import Annotated, Literal

from pydantic import Field

from invertwin.cli.schema.section import Positive, Section, Vector


class Initial(Section):
    """Where an object stands by conventional processing: the fit starts there, not where the
    scene has it."""

    object: str
    """name in the scene"""
    low: Vector
    """m, corner of the box of the world that is searched"""
    high: Vector
    """m, its opposite corner"""
    method: Literal["points", "image"] = "points"
    """points = of a CFAR detector; image = backprojected power"""
    pose: Literal["rectangle", "axes", "position"] = "rectangle"
    """how it stands: the near sides of a rectangle, principal axes, or no turn"""
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
