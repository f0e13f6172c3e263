"""The table of radar signatures."""

from typing import Annotated, Any, Literal

import torch
from annotated_types import MinLen
from pydantic import model_validator
from torch import Tensor

from invertwin.limits import CountOfTwo, Positive
from invertwin.refusals import refusal_text
from invertwin.registry.kinds import ConstructorTable, FormOf, OneOf
from invertwin.registry.section import InputPath, Section, prefix_errors, raise_key_error
from invertwin.signatures import Signature, aspect_directions

POLARISATION_LETTERS = {"V": "VH", "H": "HV", "circular": "RL"}
"""The two polarisations of a matrix, by what was asked for."""


class SweepTable(Section):
    """Evenly spaced numbers.

    Attributes:
        start: first
        stop: last
        count: how many, both ends with them
    """

    start: float
    stop: float
    count: CountOfTwo


SweptValues = Annotated[Any, FormOf((float, Annotated[list[float], MinLen(1)], SweepTable))]


def count_values(value: Any) -> int:
    """Count the numbers of a sweep, a list or a single one."""
    if isinstance(value, SweepTable):
        return value.count
    return len(value) if isinstance(value, list) else 1


def expand_values(value: Any) -> Tensor:
    """The numbers of a sweep, a list or a single one."""
    if isinstance(value, SweepTable):
        return torch.linspace(value.start, value.stop, value.count, dtype=torch.float64)
    return torch.atleast_1d(torch.tensor(value, dtype=torch.float64))


class ReceiverDirection(Section):
    """Direction of a bistatic receiver.

    Attributes:
        theta_deg: angle to z, one for all or one for each aspect
        phi_deg: angle from x towards y
    """

    theta_deg: SweptValues
    phi_deg: SweptValues


class RcsCase(Section):
    """Radar cross-section that is known from another source.

    Attributes:
        reference: what it should be
        channel: received and sent polarisation
        part: such as "order 3"; without it the whole field
        statistic: of the dB errors over all frequencies and aspects
    """

    reference: Annotated[Any, OneOf("cross_section")]
    channel: Literal["VV", "HH", "VH", "HV", "RR", "LL", "RL", "LR"]
    part: str | None = None
    statistic: Literal["max", "rms"] = "max"


class RcsMeasurement(Section):
    """A measured radar cross-section; rows of the swept angles and frequencies are compared.

    Attributes:
        file: rows of frequency [Hz], θ [°], φ [°], RCS [dBsm]
        channel: received and sent polarisation
    """

    file: InputPath
    channel: Literal["VV", "HH", "VH", "HV"]


class RcsImageTable(Section):
    """A focused image of the sweep.

    Attributes:
        extent: m, half its side
        pixels: along each side
    """

    extent: Positive
    pixels: CountOfTwo = 128


class RcsTable(ConstructorTable):
    """The radar cross-section of the scene, far away: the arguments of `invertwin.rcs`.

    Attributes:
        frequencies: Hz: one, a list, or start, stop and count
        theta_deg: angle from z to the radar: one for all aspects, or one for each
        phi_deg: angle from x towards y: one for all aspects, or one for each
        receiver: without it the transmitter receives
        polarisation: sent; V and H lie along θ and φ about `up`, circular is right-hand
        cases: [rcs.cases.<name>]: what results are compared with
        measured: [[rcs.measured]]: measurements to compare with
        profile: draw range profiles; needs evenly spaced frequencies
        image: draw an image in the plane of the sweep
    """

    frequencies: SweptValues
    theta_deg: SweptValues = 90.0
    phi_deg: SweptValues = 0.0
    receiver: ReceiverDirection | None = None
    polarisation: Literal["V", "H", "circular"] = "V"
    cases: dict[str, RcsCase] = {}
    measured: list[RcsMeasurement] = []
    profile: bool = False
    image: RcsImageTable | None = None

    def build(self, given: Any = None, /, **more: Any) -> Signature:
        """The signature of a scene."""
        both = {"directions": _unit_directions(self)}
        if self.receiver is not None:
            with prefix_errors("receiver"):
                both["receivers"] = _unit_directions(self.receiver).expand_as(both["directions"])
        return super().build(given, frequencies=expand_values(self.frequencies), **both, **more)

    @property
    def channels(self) -> dict[str, tuple[int, int]]:
        """Row and column of a matrix by the letters of received and sent polarisation."""
        letters = POLARISATION_LETTERS[self.polarisation]
        return {a + b: (i, j) for i, a in enumerate(letters) for j, b in enumerate(letters)}

    @model_validator(mode="after")
    def _check_channels(self) -> "RcsTable":
        known = self.channels
        named = {f"cases.{name}": case.channel for name, case in self.cases.items()}
        named |= {f"measured[{i}]": m.channel for i, m in enumerate(self.measured)}
        for path, channel in named.items():
            if channel not in known:
                names = ", ".join(known)
                text = refusal_text("signature.channel", self.polarisation, names, channel)
                raise_key_error(text, f"{path}.channel")
        theta, phi = count_values(self.theta_deg), count_values(self.phi_deg)
        if theta != phi and 1 not in (theta, phi):
            raise_key_error(refusal_text("signature.unequal_angles", theta, phi), "phi_deg")
        return self

    @property
    def aspect_count(self) -> int:
        """Number of swept directions."""
        return max(count_values(self.theta_deg), count_values(self.phi_deg))

    def select_aspects(self, indices: list[int]) -> "RcsTable":
        """Return the table for a subset of aspects, without comparisons."""

        def select_angles(section: Any) -> dict[str, list[float]]:
            angles = {n: expand_values(getattr(section, n)) for n in ("theta_deg", "phi_deg")}
            return {n: a.expand(self.aspect_count)[indices].tolist() for n, a in angles.items()}

        receiver = self.receiver and self.receiver.model_copy(update=select_angles(self.receiver))
        return self.model_copy(update={**select_angles(self), "receiver": receiver})

    @property
    def swept_angles(self) -> tuple[Tensor, str]:
        """Angles that change from aspect to aspect [°], and their name."""
        theta, phi = expand_values(self.theta_deg), expand_values(self.phi_deg)
        return (theta, "θ [°]") if len(theta) > len(phi) else (phi, "φ [°]")


def _unit_directions(table: RcsTable | ReceiverDirection) -> Tensor:
    angles = (table.theta_deg, table.phi_deg)
    return aspect_directions(*(expand_values(angle).deg2rad() for angle in angles))
