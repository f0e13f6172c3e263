"""Memory of a search: its results by their input, so that it can stop, and go on later."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from invertwin.discovery.shapes.primitives import ShapeParameters, Shapes
from invertwin.errors import InputError
from invertwin.inversion.fingerprint import Fingerprint
from invertwin.storage.folders import replace_file
from invertwin.storage.untrusted import convert_read_errors, read_text

_Result = TypeVar("_Result", Tensor, list[ShapeParameters])


@dataclass(eq=False)
class SearchMemory:
    """Results of a search by their name and shapes.

    A search that starts with the results of an interrupted one repeats its decisions without its
    computations, and then goes on.

    Attributes:
        heed: raises KeyboardInterrupt if the search should stop.
        results: tensors and lists of shapes by name and shapes.
    """

    heed: Callable[[], None] = lambda: None
    results: dict[tuple[str, tuple[ShapeParameters, ...]], Any] = field(default_factory=dict)

    def recall(self, name: str, shapes: Shapes, compute: Callable[[], _Result]) -> _Result:
        """Return a result, computed at the first call; those of prisms always.

        Args:
            name: name of the result.
            shapes: shapes that it depends on.
            compute: function that computes it.
        """
        key = name, tuple(shapes)
        if key in self.results:
            return self.results[key]
        self.heed()
        found = compute()
        if all(one.kind != "prism" for one in shapes):  # whose outlines are not compared
            self.results[key] = found
        return found

    def save(self, file: Path, search: Fingerprint) -> None:
        """Write the results to a file.

        Args:
            file: path of the file.
            search: fingerprint of the search.
        """
        rows = [(*key, result) for key, result in self.results.items()]
        stored = {"search": search.content(), "results": rows}
        text = json.dumps(stored, default=lambda one: getattr(one, "tolist", lambda: vars(one))())
        with replace_file(file) as part:
            part.write_text(text, encoding="utf-8")

    def load(self, file: Path, search: Fingerprint) -> None:
        """Read the results of an interrupted search.

        Args:
            file: path of the file.
            search: fingerprint of the search.

        Raises:
            InputError: A file that cannot be read, or of another search.
        """
        with convert_read_errors(file, "a whole checkpoint", "delete it or start without resume"):
            stored = json.loads(read_text(file, "a checkpoint"))
            if not search.matches(stored["search"]):
                differ = "recording, region, level, rays or seed differ"
                problem = f"expected a checkpoint of this search in {file}, got one of another"
                raise InputError(f"{problem} ({differ}); start without resume")
            for name, shapes, value in stored["results"]:
                fitted = bool(value) and isinstance(value[0], dict)
                result = _read_shapes(value) if fitted else torch.tensor(value, dtype=torch.float64)
                self.results[name, tuple(_read_shapes(shapes))] = result


def _read_shapes(rows: Any) -> list[ShapeParameters]:
    for row in rows:
        row["position"] = tuple(row["position"])
    return [ShapeParameters(**row) for row in rows]
