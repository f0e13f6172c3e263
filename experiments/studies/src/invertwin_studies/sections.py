"""The run-file sections of the studies: other ways to a derivative, and losses along a line."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import Field

from invertwin.registry.section import Section

if TYPE_CHECKING:  # run files are read in milliseconds, the rest takes seconds to import
    from matplotlib.figure import Figure

    from invertwin.cli.commands.gradcheck import GradcheckOutcome
    from invertwin.cli.report import ReportTable

Subarray = Annotated[list[Annotated[int, Field(ge=1)]], Field(min_length=2, max_length=2)]
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]


class Methods(Section):
    """Other ways to the derivative of a gradient check, in one table with ours."""

    points_per_m2: float = Field(
        6e3, gt=0, description="rough points per m² of the exact signals that MUSIC is given"
    )
    sources: int = Field(6, ge=1, description="of MUSIC, in every range bin")
    smoothing: Subarray = Field([8, 6], description="elements along y, z of the subarrays of MUSIC")
    samples: int = Field(
        400_000, ge=1, description="rays of the other ray tracers, and as many points on edges"
    )

    picture_note: ClassVar[str] = (
        "Derivatives summed over elevation (range × azimuth) and over range (elevation × azimuth). "
        "Red: grows with θ; blue: falls. One colour scale for all that have a unit of power."
    )

    def compare(self, checked: "GradcheckOutcome") -> "tuple[dict[str, Any], Figure]":
        """What metrics.json holds of every method, and the figure of all maps."""
        from invertwin_studies.methods import compare

        return compare(self, checked)

    def table(self, name: str, found: Mapping[str, Any]) -> "ReportTable":
        """One row a method; what is not installed says so.

        Args:
            name: Of the gradient check.
            found: What `compare` found.
        """
        from invertwin_studies.methods import methods_table

        return methods_table(name, found)


class LossScan(Section):
    """Losses of the raw signal, its range profile, MUSIC and the surrogate along a line."""

    object: str = Field(description="name in the scene")
    axis: Vector = Field(description="direction of the line")
    span: float = Field(0.02, gt=0, description="m on either side of the truth")
    points: int = Field(201, ge=3, description="on the line")
    wide_span: float = Field(0.4, gt=0, description="m on either side, surrogate alone")
    wide_points: int = Field(41, ge=3, description="on that line")
    sources: int = Field(6, ge=1, description="of MUSIC, in every range bin")
    smoothing: Subarray = Field([8, 6], description="elements along y, z of the subarrays of MUSIC")
    samples: int = Field(200_000, ge=1, description="rays of the surrogate at each point")
