"""Parts of the tables of a run file: numbers, paths, and tables with known keys only.

Nothing here imports torch, so that the command line can say what it offers without it.
"""

import difflib
import inspect
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Annotated, Any, NoReturn, get_args

from annotated_types import Ge, Le, Len, Lt, MinLen
from pydantic import AfterValidator, BaseModel, ConfigDict, Discriminator, model_validator
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError, ValidationError
from pydantic_core.core_schema import ErrorType

from invertwin.errors import InputError

Depth = Annotated[int, Ge(1), Le(16)]
Seed = Annotated[int, Ge(0), Lt(2**31)]
Vector = Annotated[list[float], Len(3, 3)]
Counts = Annotated[list[Annotated[int, Ge(2)]], Len(3, 3)]

_PYDANTIC_ERRORS = frozenset(get_args(ErrorType))  # kinds of errors that pydantic itself knows
# Pydantic puts the tag of a union into an error's location; the mark tells it from a key.
TAG_MARK = "→"

_MAX_UNKNOWN = 20  # keys that errors name

# In docstrings: descriptions of all arguments, and of one or of several together.
_ARGUMENTS = re.compile(r"^(?:Args|Attributes):\n((?:(?: {4}.*)?\n?)+)", re.MULTILINE)
_ARGUMENT = re.compile(r"^ {4}(\w+(?:, \w+)*): (.*(?:\n {8}.*)*)", re.MULTILINE)

# Beside the checkout; for an installed package this is a folder that does not exist.
_CHECKOUT_DATA = Path(__file__).resolve().parents[4] / "shared" / "data"


def _resolve_input_path(name: str, info: Any) -> str:
    """Relative paths start at the run file's folder, then at the data folder."""
    beside = (info.context or {}).get("folder", Path())
    folders = (beside, os.environ.get("INVERTWIN_DATA", _CHECKOUT_DATA))
    paths = [Path(folder, name).absolute() for folder in folders]
    return str(next(filter(os.path.exists, paths), paths[0]))


def _reject_control_characters(text: str) -> str:
    if not text.isprintable():
        raise PydanticCustomError("words", "expected text without control characters")
    return text


PrintableText = Annotated[str, AfterValidator(_reject_control_characters)]
InputPath = Annotated[str, MinLen(1), AfterValidator(_resolve_input_path)]
"""Path of a file or folder, from the run file's folder, then from INVERTWIN_DATA."""


class KeyInputError(InputError):
    """Bad input at a key of the run file.

    Args:
        path: Path of the key.
        text: Description of the fault.
    """

    def __init__(self, path: str, text: str) -> None:
        super().__init__(f"{path}: {text}")
        self.path, self.text = path, text


@contextmanager
def prefix_errors(path: str) -> Iterator[None]:
    """Add the key of the run file to errors of the library."""
    try:
        yield
    except KeyInputError as error:
        raise KeyInputError(f"{path}.{error.path}", error.text) from None
    except InputError as error:
        raise KeyInputError(f"{path}.{error.at}" if error.at else path, str(error)) from None


class Section(BaseModel):
    """A table of the run file; keys it does not know are errors that name the nearest match.

    Its keys are described in the docstring, under `Attributes:`.
    """

    # Which kinds there are is known once all modules are imported, so validators are built late.
    model_config = ConfigDict(
        extra="forbid", strict=True, frozen=True, allow_inf_nan=False, defer_build=True
    )

    @model_validator(mode="wrap")
    @classmethod
    def _check_unknown_keys(cls, data: Any, handler: Callable[[Any], Any]) -> Any:
        """Tell unknown keys, beside what is wrong with the known ones."""
        names = list(cls.model_fields)
        unknown = [name for name in data if name not in names] if isinstance(data, dict) else []
        if not unknown:
            return handler(data)
        unknown = unknown[:_MAX_UNKNOWN]
        # Pydantic's own error for an extra key does not carry the keys that are allowed.
        contexts = [{"key": name, "allowed": names} for name in unknown]
        kinds = [PydanticCustomError("unknown_key", "unknown key", context) for context in contexts]
        found = [InitErrorDetails(type=kind, loc=(), input=data) for kind in kinds]
        meant = {m for n in unknown for m in difflib.get_close_matches(str(n), names, cutoff=0.5)}
        try:
            handler({name: value for name, value in data.items() if name in names})
        except ValidationError as error:
            for row in error.errors(include_url=False):
                # A key that is misspelt is not missing, too.
                if row["type"] == "missing" and row["loc"] and row["loc"][0] in meant:
                    continue
                found.append(_to_init_error(row))
        raise ValidationError.from_exception_data(cls.__name__, found)

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: Any, handler: Any) -> dict[str, Any]:
        """Describe the table and its keys as the docstring does."""
        found = handler(core_schema)
        table, texts = handler.resolve_ref_schema(found), argument_docs(cls)
        if "description" in table:
            table["description"] = table["description"].partition("\n\nAttributes:")[0]
        for name, value in table.get("properties", {}).items():
            if name in texts:
                value.setdefault("description", texts[name])
        return found


@cache
def argument_docs(make: Any) -> dict[str, str]:
    """Read the descriptions in `Attributes:` and `Args:` by name, bases first.

    Args:
        make: A class or a function.
    """
    found: dict[str, str] = {}
    owners = reversed(make.__mro__[:-1]) if isinstance(make, type) else [make]
    for owner in owners:
        texts = [owner.__doc__, owner.__init__.__doc__ if isinstance(make, type) else None]
        for text in map(inspect.cleandoc, filter(None, texts)):
            for part in _ARGUMENTS.findall(text):
                for names, words in _ARGUMENT.findall(part):
                    for name in names.split(", "):
                        found.setdefault(name, " ".join(words.split()).removesuffix("."))
    return found


def _to_init_error(row: ErrorDetails) -> InitErrorDetails:
    """An error of pydantic as one that can be raised again."""
    kind, context = row["type"], row.get("ctx", {})
    if kind not in _PYDANTIC_ERRORS:
        own = PydanticCustomError(kind, "{text}", {**context, "text": row["msg"]})  # type: ignore[arg-type]
        return InitErrorDetails(type=own, loc=row["loc"], input=row["input"])
    return InitErrorDetails(type=kind, loc=row["loc"], input=row["input"], ctx=context)


def tag_by(keys: tuple[str, ...], default: str | None = None) -> Discriminator:
    """Choose a union's member by the first of `keys` that is present.

    Args:
        keys: `kind` or `shape` tell the member by their value, others by their presence.
        default: The member without any of them.
    """

    def tag(value: Any) -> str | None:
        if isinstance(value, list):
            return TAG_MARK + "points"
        for name in keys:
            found = value.get(name) if isinstance(value, dict) else getattr(value, name, None)
            if found is not None:
                return TAG_MARK + (str(found) if name in ("kind", "shape") else name)
        return TAG_MARK + default if default and isinstance(value, dict) else None

    tag.__name__ = ",".join(keys)  # pydantic quotes it in its errors, and run_file reads it
    return Discriminator(tag)


def check_presence(section: Section, wanted: dict[str, bool], when: str) -> None:
    """Refuse keys that are missing, or that should not be there.

    Args:
        section: The table.
        wanted: For each name, whether the key must be there or must not.
        when: Condition, for the error.
    """
    for name, needed in wanted.items():
        if needed != (getattr(section, name) is not None):
            verb, got, do = ("", "none", "add it") if needed else ("no ", "one", "remove it")
            raise_key_error(f"expected {verb}`{name}` {when}, got {got}; {do}")


def require_section(run: Any, section: str, command: str, otherwise: str = "add it") -> Any:
    """A section that a command cannot do without.

    Args:
        run: The run file.
        section: Name of the section.
        command: Command that needs it, for the error.
        otherwise: Remedy without it, for the error.

    Raises:
        InputError: The run file does not have it; the message ends with `otherwise`.
    """
    found = getattr(run, section)
    observed = run.observations.values()
    if observed and all(getattr(table, section, None) for table in observed):
        return found
    if found in (None, []):
        said = f"expected a section [{section}] for {command}, got a run file without one"
        raise InputError(f"{said}; {otherwise}")
    return found


def raise_key_error(text: str, path: str = "") -> NoReturn:
    """Raise an error of the run file.

    Args:
        text: Description of the fault.
        path: Path of the key; without it the error is of the whole section.
    """
    raise PydanticCustomError("section", "{text}", {"text": text, "path": path})


def suggest_name(given: str, allowed: Sequence[str], otherwise: str, cutoff: float = 0.5) -> str:
    """Suggest the name that a user may have meant, as the end of an error.

    Args:
        given: The name.
        allowed: Names that there are.
        otherwise: Remedy where none is alike.
        cutoff: Least similarity of names that are alike, up to 1.
    """
    close = difflib.get_close_matches(given, allowed, n=1, cutoff=cutoff)
    return f"did you mean `{close[0]}`?" if close else otherwise
