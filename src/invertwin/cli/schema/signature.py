"""The table of radar signatures."""

from typing import Annotated, Any, Literal

import torch
from annotated_types import MinLen
from pydantic import GetCoreSchemaHandler, model_validator
from torch import Tensor

from invertwin.limits import Positive, Several
from invertwin.registry.kinds import OneOf, Table, number_or_list
from invertwin.registry.section import InputPath, Section, about, fail, key
from invertwin.signatures import Signature, aspects

LETTERS = {"V": "VH", "H": "HV", "circular": "RL"}
"""The two polarisations of a matrix, by what was asked for."""


class Sweep(Section):
    """Evenly spaced numbers."""

    start: float = key("first")
    stop: float = key("last")
    count: Several = key("how many, both ends with them")


class _Numbers:
    """Annotates a key that is one number, a list, or a sweep."""

    @classmethod
    def __get_pydantic_core_schema__(cls, _: Any, handler: GetCoreSchemaHandler) -> Any:
        kind = number_or_list(float, Annotated[list[float], MinLen(1)], Sweep)
        return handler.generate_schema(kind)


Swept = Annotated[Any, _Numbers]


def count_of(value: Any) -> int:
    """How many numbers a sweep, a list or a single one has."""
    if isinstance(value, Sweep):
        return value.count
    return len(value) if isinstance(value, list) else 1


def swept(value: Any) -> Tensor:
    """The numbers of a sweep, a list or a single one."""
    if isinstance(value, Sweep):
        return torch.linspace(value.start, value.stop, value.count, dtype=torch.float64)
    return torch.atleast_1d(torch.tensor(value, dtype=torch.float64))


class Direction(Section):
    """Where the receiver is, apart from the transmitter."""

    theta_deg: Swept = key("angle to z, one for all or one for each aspect")
    phi_deg: Swept = key("angle from x towards y")


class Case(Section):
    """A radar cross-section that is known otherwise."""

    reference: Annotated[Any, OneOf("cross_section")] = key("what it should be")
    channel: Literal["VV", "HH", "VH", "HV", "RR", "LL", "RL", "LR"] = key(
        "received and sent polarisation"
    )
    part: str | None = key('such as "order 3"; without it the whole field', None)
    statistic: Literal["max", "rms"] = key(
        "of the dB errors over all frequencies and aspects", "max"
    )


class Measurement(Section):
    """A measured radar cross-section; rows of the swept angles and frequencies are compared."""

    file: InputPath = key("rows of frequency [Hz], θ [°], φ [°], RCS [dBsm]")
    channel: Literal["VV", "HH", "VH", "HV"] = key("received and sent polarisation")


class Image(Section):
    """A focused image of the sweep."""

    extent: Positive = key("m, half its side")
    pixels: Several = key("along each side", 128)


class Rcs(Table):
    """The radar cross-section of the scene, far away: the arguments of `invertwin.rcs`."""

    frequencies: Swept = key("Hz: one, a list, or start, stop and count")
    theta_deg: Swept = key("angle from z to the radar: one for all aspects, or one for each", 90.0)
    phi_deg: Swept = key("angle from x towards y: one for all aspects, or one for each", 0.0)
    receiver: Direction | None = key("without it the transmitter receives", None)
    polarisation: Literal["V", "H", "circular"] = key(
        "sent; V and H lie along θ and φ about `up`, circular is right-hand", "V"
    )
    cases: dict[str, Case] = key("[rcs.cases.<name>]: what results are compared with", {})
    measured: list[Measurement] = key("[[rcs.measured]]: measurements to compare with", [])
    profile: bool = key("draw range profiles; needs evenly spaced frequencies", False)
    image: Image | None = key("draw an image in the plane of the sweep", None)

    def build(self, given: Any = None, /, **more: Any) -> Signature:
        """The signature of a scene."""
        both = {"directions": _towards(self)}
        if self.receiver is not None:
            with about("receiver"):
                both["receivers"] = _towards(self.receiver).expand(len(both["directions"]), 3)
        return super().build(given, frequencies=swept(self.frequencies), **both, **more)

    @property
    def channels(self) -> dict[str, tuple[int, int]]:
        """Row and column of a matrix by the letters of received and sent polarisation."""
        letters = LETTERS[self.polarisation]
        return {a + b: (i, j) for i, a in enumerate(letters) for j, b in enumerate(letters)}

    @model_validator(mode="after")
    def _channels_are_there(self) -> "Rcs":
        known = self.channels
        named = {f"cases.{name}": case.channel for name, case in self.cases.items()}
        named |= {f"measured[{i}]": m.channel for i, m in enumerate(self.measured)}
        for path, channel in named.items():
            if channel not in known:
                fail(
                    f"expected a channel of polarisation {self.polarisation} "
                    f"({', '.join(known)}), got {channel}; choose one",
                    f"{path}.channel",
                )
        theta, phi = count_of(self.theta_deg), count_of(self.phi_deg)
        if theta != phi and 1 not in (theta, phi):
            fail(f"expected one angle or as many as theta_deg ({theta}), got {phi}", "phi_deg")
        return self

    @property
    def aspect_count(self) -> int:
        """How many directions are swept."""
        return max(count_of(self.theta_deg), count_of(self.phi_deg))

    def at(self, aspects: list[int]) -> "Rcs":
        """The same of some aspects, and nothing to compare them with."""

        def chosen(section: Any) -> dict[str, list[float]]:
            return {
                name: swept(getattr(section, name)).expand(self.aspect_count)[aspects].tolist()
                for name in ("theta_deg", "phi_deg")
            }

        receiver = self.receiver and self.receiver.model_copy(update=chosen(self.receiver))
        return self.model_copy(update={**chosen(self), "receiver": receiver})

    @property
    def angles(self) -> tuple[Tensor, str]:
        """What changes from aspect to aspect [°], and its name."""
        theta, phi = swept(self.theta_deg), swept(self.phi_deg)
        return (theta, "θ [°]") if len(theta) > len(phi) else (phi, "φ [°]")


def _towards(table: Rcs | Direction) -> Tensor:
    return aspects(swept(table.theta_deg).deg2rad(), swept(table.phi_deg).deg2rad())
