"""Contents of a viewer as plain arrays: layers, the steps of a fit, and maps of its data."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float32, Int32
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, TypeAdapter
from torch import Tensor

from invertwin.channel import Grid
from invertwin.storage.folders import replace_file
from invertwin.storage.untrusted import convert_read_errors, read_arrays

_FORMAT_VERSION = 2
_RERUN_ADVICE = "repeat the run with --overwrite"
_MAX_VALUES = 2_000_000  # of maps that are kept
SCENE_GROUPS = ("twin", "truth", "start")
"""Groups of layers that are surfaces of a scene."""

_Level = Annotated[float, Field(ge=-1e9, le=1e9)]


@dataclass(frozen=True, eq=False)
class DisplayMesh:
    """A surface in the world.

    Attributes:
        vertices: Places [m], float32 [v, 3].
        faces: Corners of the triangles, int32 [t, 3].
    """

    vertices: Float32[np.ndarray, "_ 3"]
    faces: Int32[np.ndarray, "_ 3"]


@dataclass(frozen=True, eq=False)
class DisplayLayer:
    """One thing that can be shown and hidden.

    Attributes:
        name: Group and name, such as "twin/letter"; groups are switched together.
        kind: A surface, pairs of points that are joined, or points.
        points: Places [m], float32 [n, 3].
        faces: Of a surface, int32 [t, 3]; else empty.
        color: Red, green and blue, 0 to 255.
        opacity: 1 hides what is behind.
        shown: Whether it is seen at first.
        band: Of cells of a map, their lowest and highest value.
        unit: Of these values.
    """

    name: str
    kind: Literal["surface", "lines", "points"]
    points: Float32[np.ndarray, "_ 3"]
    faces: Int32[np.ndarray, "_ 3"] = field(default_factory=lambda: np.zeros((0, 3), np.int32))
    color: tuple[int, int, int] = (185, 190, 199)
    opacity: float = 1.0
    shown: bool = True
    band: tuple[_Level, _Level] | None = None
    unit: str = ""

    @property
    def group(self) -> str:
        """Name of the switch of the layer."""
        return self.name.split("/")[0]


@dataclass(frozen=True, eq=False)
class DisplayStep:
    """State of a fit at a step.

    Attributes:
        number: Steps done.
        label: Such as "step 12, loss 0.31".
        bodies: What moves, by the name of its object.
    """

    number: int
    label: str
    bodies: Mapping[str, DisplayMesh]


@dataclass(frozen=True, eq=False)
class DisplayMaps:
    """Power over range and direction, of some frames of a radar.

    Attributes:
        frames: Numbers of the frames.
        ranges: Range of each row [m].
        across: Direction cosine u of each column.
        power: By what is shown, float32 [frame, range, u]: the strongest over v.
    """

    frames: list[int]
    ranges: list[float]
    across: list[float]
    power: Mapping[str, Float32[np.ndarray, "_ _ _"]]

    @classmethod
    def from_spectra(
        cls, spectra: Mapping[str, Tensor], grid: Grid, max_values: int | None = None
    ) -> "DisplayMaps":
        """Maps of spectra [frame, range, u, v]; of many frames, evenly chosen ones.

        Args:
            spectra: By what is shown, all of one shape.
            grid: Their bins.
            max_values: Values that are kept, about; None = of a few megabytes.
        """
        frames, ranges, across, _ = next(iter(spectra.values())).shape
        count = max(1, min(frames, (max_values or _MAX_VALUES) // (len(spectra) * ranges * across)))
        chosen = np.unique(np.linspace(0, frames - 1, count).astype(int)).tolist()
        tops = {name: power.detach()[chosen].amax(3).cpu() for name, power in spectra.items()}
        kept = {name: np.asarray(power, np.float32) for name, power in tops.items()}
        return cls(chosen, grid.ranges.tolist(), grid.u.tolist(), kept)

    def maps_of_frame(self, frame: int) -> dict[str, NDArray[np.float32]]:
        """The maps of a frame; none, where they were not kept.

        Args:
            frame: Its number.
        """
        if frame not in self.frames:
            return {}
        number = self.frames.index(frame)
        return {name: power[number] for name, power in self.power.items()}


@dataclass(frozen=True, eq=False)
class Display:
    """Everything that a viewer shows.

    Attributes:
        title: Of the window.
        layers: In the order in which they are listed.
        steps: Of a fit, in order; they move the layers "twin/<object>".
        maps: Of every sensor that has data, by its name; the only one has an empty name.
        up: The direction that points up.
        ahead: The direction in which the radar looks.
        answer: What a run found, in a sentence.
        shows_start: True if the first step is shown first, as of motions in time, not the last.
    """

    __pydantic_config__ = ConfigDict(
        arbitrary_types_allowed=True, extra="forbid", allow_inf_nan=False
    )

    title: str
    layers: Sequence[DisplayLayer]
    steps: Sequence[DisplayStep] = ()
    maps: Mapping[str, DisplayMaps] = field(default_factory=dict)
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    ahead: tuple[float, float, float] = (1.0, 0.0, 0.0)
    answer: str = ""
    shows_start: bool = False

    @property
    def box(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Lowest and highest corner of the scene; of everything, where there is none."""
        bodies = [x for x in self.layers if x.group in SCENE_GROUPS and len(x.points)]
        points = [x.points for x in bodies or self.layers if len(x.points)]
        every = np.concatenate(points) if points else np.zeros((1, 3), np.float32)
        return every.min(0), every.max(0)

    @property
    def sight(self) -> tuple[float, float, float]:
        """Level direction of the first camera: that of the radar, or from a transmitter on."""
        masts = [x.points[0] for x in self.layers if x.name == "transmitters" and len(x.points)]
        away = (np.mean(self.box, 0) - np.reshape(masts[:1], (-1, 3))) * (1 - np.abs(self.up))
        length = float(np.linalg.norm(away))
        return (*(away[0] / length).tolist(),) if length > 0 else self.ahead

    @property
    def groups(self) -> dict[str, bool]:
        """Groups of layers in order, and whether they are seen at first."""
        found: dict[str, bool] = {}
        for layer in self.layers:
            found.setdefault(layer.group, layer.shown)
        return found

    def show_step(self, step: DisplayStep) -> "Display":
        """The display with the bodies of a step in place of the twin's.

        Args:
            step: One of the steps.
        """
        bodies: dict[str, Any] = {
            f"twin/{name}": {"points": body.vertices, "faces": body.faces}
            for name, body in step.bodies.items()
        }
        layers = [replace(layer, **bodies.get(layer.name, {})) for layer in self.layers]
        return replace(self, layers=layers)

    def save(self, path: str | Path) -> None:
        """Write everything into one .npz file.

        Args:
            path: The file.
        """
        arrays: dict[int, NDArray[Any]] = {}  # by identity: faces of steps are mostly the same

        def to_json(value: Any) -> Any:
            if isinstance(value, np.ndarray):
                arrays[id(value)] = value
                return {"array": f"a{list(arrays).index(id(value))}"}
            return dict(value) if isinstance(value, Mapping) else vars(value)

        header = np.array(json.dumps(vars(self) | {"format": _FORMAT_VERSION}, default=to_json))
        named = {f"a{number}": array for number, array in enumerate(arrays.values())}
        # A run that is killed meanwhile goes on from the file before.
        with replace_file(path) as part:
            np.savez_compressed(part, allow_pickle=False, header=header, **named)

    @classmethod
    def load(cls, path: str | Path) -> "Display":
        """Read what `save` wrote.

        Args:
            path: The file.

        Raises:
            InputError: A damaged file, or one of another version.
        """
        with convert_read_errors(path, "what a fit leaves to be viewed", _RERUN_ADVICE):
            arrays = read_arrays(path, _RERUN_ADVICE)

            def restore_array(value: dict[str, Any]) -> Any:
                return arrays[value["array"]] if set(value) == {"array"} else value

            read = json.loads(str(arrays["header"]), object_hook=restore_array)
            if read.pop("format") != _FORMAT_VERSION:
                raise ValueError("of another version")
            found = _STORED.validate_python(read)
            bodies = [body for step in found.steps for body in step.bodies.values()]
            for body in (*found.layers, *bodies):
                _check_triangles(body)
            for maps in found.maps.values():
                shape = len(maps.frames), len(maps.ranges), len(maps.across)
                if 0 in shape or any(power.shape != shape for power in maps.power.values()):
                    raise ValueError(f"expected maps of {shape} values")
            return found


_STORED = TypeAdapter(Display)


def _check_triangles(mesh: DisplayLayer | DisplayMesh) -> None:
    """Refuse what would crash the graphics of a browser."""
    points = mesh.points if isinstance(mesh, DisplayLayer) else mesh.vertices
    inside = not mesh.faces.size or 0 <= mesh.faces.min() <= mesh.faces.max() < len(points)
    if not inside or not np.isfinite(points).all():
        raise ValueError("triangles without corners")
