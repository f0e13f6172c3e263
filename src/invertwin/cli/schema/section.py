"""What every table of a run file is made of: numbers, paths, and tables with known keys only."""

import os
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

from pydantic import AfterValidator, BaseModel, ConfigDict, Discriminator, Field, model_validator
from pydantic_core import PydanticCustomError

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(ge=1)]
Depth = Annotated[int, Field(ge=1, le=16)]
Seed = Annotated[int, Field(ge=0, lt=2**31)]
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]


# Beside the checkout; for an installed package this is a folder that does not exist.
_DATA_BESIDE_CHECKOUT = Path(__file__).resolve().parents[5] / "shared" / "data"


def _beside_run_file(name: str, info: Any) -> str:
    """Relative paths start at the run file's folder, then at the data folder."""
    folders = [
        (info.context or {}).get("folder", Path()),
        os.environ.get("INVERTWIN_DATA", _DATA_BESIDE_CHECKOUT),
    ]
    paths = [Path(folder, name).absolute() for folder in folders]
    return str(next((path for path in paths if path.exists()), paths[0]))


InputPath = Annotated[str, Field(min_length=1), AfterValidator(_beside_run_file)]
Interval = Annotated[list[NonNegative], Field(min_length=2, max_length=2)]


# Pydantic puts the tag of a union into an error's location; the mark tells it from a key.
TAG_MARK = "→"


def tag_by(*keys: str) -> Discriminator:
    """A union's member by the first of `keys` that is present: its value if it is `kind` or
    `shape`, else the key itself."""

    def tag(value: Any) -> str | None:
        if isinstance(value, list):
            return TAG_MARK + "points"
        for key in keys:
            found = value.get(key) if isinstance(value, dict) else getattr(value, key, None)
            if found is not None:
                return TAG_MARK + (str(found) if key in ("kind", "shape") else key)
        return None

    tag.__name__ = ",".join(keys)  # pydantic quotes it in its errors, and run_file reads it
    return Discriminator(tag)


WorldAxes = Annotated[list[Literal["x", "y", "z"]], Field(min_length=1)]


class Section(BaseModel):
    """A table of the run file; keys it does not know are errors that name the nearest match."""

    model_config = ConfigDict(
        extra="forbid", strict=True, frozen=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

    @model_validator(mode="before")
    @classmethod
    def _known_keys_only(cls, data: Any) -> Any:
        # Pydantic's own error for an extra key does not carry the keys that are allowed.
        if isinstance(data, dict):
            for key in data:
                if key not in cls.model_fields:
                    raise PydanticCustomError(
                        "unknown_key",
                        "unknown key",
                        {"key": key, "allowed": list(cls.model_fields)},
                    )
        return data


def check_presence(section: Section, wanted: dict[str, bool], when: str) -> None:
    """Keys that one kind needs and the others must not have."""
    for key, needed in wanted.items():
        if needed != (getattr(section, key) is not None):
            verb, do = ("", "add it") if needed else ("no ", "remove it")
            fail(f"expected {verb}`{key}` {when}; {do}")


def fail(text: str, path: str = "") -> NoReturn:
    """An error of a whole section, or of the key `path` of the run file."""
    raise PydanticCustomError("section", "{text}", {"text": text, "path": path})
