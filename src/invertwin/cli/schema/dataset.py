"""The tables of data sets: what every sample holds, and what is drawn for it."""

from typing import Annotated, Any, Literal

from annotated_types import MinLen
from pydantic import model_validator

from invertwin.cli.schema.variation import parse_key_path
from invertwin.datasets import Choice, Integer, LogUniform, Normal, Presence, Uniform
from invertwin.limits import Count
from invertwin.refusals import refusal_text
from invertwin.registry.kinds import ConstructorTable, FormOf, KindGroup, Registry
from invertwin.registry.section import PrintableText, Section, raise_key_error

_DATASET_SECTIONS = ("task", "frame", "seed", "dataset", "vary")  # of the data set itself
_KeyPathText = Annotated[PrintableText, MinLen(1)]
_KeyPaths = FormOf((_KeyPathText, Annotated[list[_KeyPathText], MinLen(1)]))


class DatasetTable(Section):
    """A data set: many samples of the run file, each with other values.

    Attributes:
        samples: how many
        shard: samples of a shard, which is one tar file
        signals: raw = beat signals of every channel; map = power over [grid], with [chirps] over
            range rate, too; micro_doppler = power of what moves over time and range rate, of
            [chirps]
        classes: class of an object by its name; without it its name
        masks: write how much of every triangle each radar position sees
        paths: write the paths of every sample; not with [chirps]
    """

    samples: Count
    shard: Count = 100
    signals: Annotated[list[Literal["raw", "map", "micro_doppler"]], MinLen(1)] = ["map"]
    classes: dict[str, PrintableText] = {}
    masks: bool = False
    paths: bool = False


class VaryTable(ConstructorTable):
    """Values drawn anew for every sample.

    Attributes:
        key: its path in the run file, such as scene.box.position[0]; a list of paths gets one value
    """

    key: Annotated[Any, _KeyPaths]

    @property
    def paths(self) -> list[str]:
        """Key paths of the drawn value."""
        return [self.key] if isinstance(self.key, str) else self.key

    @model_validator(mode="after")
    def _check_paths(self) -> "VaryTable":
        for path in self.paths:
            steps = parse_key_path(path)
            if not steps or steps[0] in _DATASET_SECTIONS:
                text = refusal_text("dataset.other_path", ", ".join(_DATASET_SECTIONS), path)
                raise_key_error(text, "key")
        return self


def register(registry: Registry) -> None:
    """Add the distributions."""
    registry.groups["distribution"] = KindGroup(base=VaryTable)
    kinds: dict[str, type] = {"uniform": Uniform, "log_uniform": LogUniform, "normal": Normal}
    kinds |= {"integer": Integer, "choice": Choice, "presence": Presence}
    for name, kind in kinds.items():
        registry.add("distribution", name, kind)
