"""The tables of the studies: other ways to a derivative, and losses along a line."""

from typing import Annotated

from pydantic import Field

from invertwin.cli.schema.section import Count, Positive, Section, Vector

Subarray = Annotated[list[Count], Field(min_length=2, max_length=2)]


class Methods(Section):
    """Other ways to the derivative of a gradient check, in one table with ours."""

    density: Positive = 6e3
    """rough points per m² of the exact signals that MUSIC is given"""
    sources: Count = 6
    """of MUSIC, in every range bin"""
    smoothing: Subarray = [8, 6]
    """elements along x, y of the subarrays of MUSIC"""
    samples: Count = 400_000
    """rays of the other ray tracers, and as many points on edges"""


class LossScan(Section):
    """Losses of the raw signal, its range profile, MUSIC and the surrogate along a line."""

    object: str
    """name in the scene"""
    axis: Vector
    """direction of the line"""
    span: Positive = 0.02
    """m on either side of the truth"""
    points: Annotated[int, Field(ge=3)] = 201
    """on the line"""
    wide_span: Positive = 0.4
    """m on either side, surrogate alone"""
    wide_points: Annotated[int, Field(ge=3)] = 41
    """on that line"""
    sources: Count = 6
    """of MUSIC, in every range bin"""
    smoothing: Subarray = [8, 6]
    """elements along x, y of the subarrays of MUSIC"""
    samples: Count = 200_000
    """rays of the surrogate at each point"""
