"""Sweeps over frequency as captures: Touchstone files of analysers, phase histories of SAR."""

import csv
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from invertwin.capture.capture import Capture
from invertwin.capture.readers import described_arrays
from invertwin.capture.readers.touchstone import load_touchstone
from invertwin.checks import checked_tensor
from invertwin.errors import InputError
from invertwin.radar.radar import Radar
from invertwin.radar.waveform import SteppedFrequency
from invertwin.refusals import refusal
from invertwin.scene import look_at
from invertwin.storage import untrusted

TOUCHSTONE = re.compile(r"\.s\d+p", re.IGNORECASE)
"""Ending of a Touchstone file."""
_PARAMETER = re.compile(r"S([1-9])([1-9])")
_KEYS = {
    "data": {"file", "files", "variable", "dimensions", "conjugate"},
    "sweep": {"parameter", "background", "band", "frequencies", "start_frequency", "step", "dwell"},
    "radar": {
        *("positions", "look_at", "tx_positions", "rx_positions"),
        *("range_origin", "range_center"),
    },
}
_DWELL = 1e-3  # s, of an analyser whose filter is 1 kHz wide
_SPACING_TOLERANCE = 0.01  # of a step: how far a frequency may be off; then a phase is right to 4°
_Frequencies = Float64[Tensor, " sample"]  # of a sweep [Hz]


def describes_sweeps(path: str | Path) -> bool:
    """Return True for a TOML description of sweeps: it has a section ``[sweep]``.

    Args:
        path: the TOML file.

    Raises:
        InputError: no such file.
    """
    text = untrusted.read_text(path, "a TOML description")
    return re.search(r"^\s*\[sweep\]", text, re.MULTILINE) is not None


@untrusted.safe_reader("sweeps over frequency")
def read_sweeps(path: str | Path, *, trusted: bool = False) -> Capture:
    """Read sweeps over equally spaced frequencies: one signal per frame.

    `path` is one Touchstone file (.s1p, .s2p), the sweep of a radar at the origin: S11 of one port,
    else S21. Or it is a description, in SI units. That of an analyser::

        frame = 2                     # x forward, y left, z up; without it x left, y up, z ahead

        [data]
        files = "rail_*.s2p"          # in the order of their names; or a list; or file = "one.s2p"

        [sweep]
        parameter = "S21"             # by default S11 of one port, else S21
        background = "empty.s2p"      # a sweep of the empty room, subtracted
        band = [2e9, 6e9]             # of all frequencies, those that count [Hz]

        [radar]
        positions = "rail.csv"        # x, y, z [m] of every file; or a list of points
        look_at = [2.0, 0.0, 0.0]     # boresight; without it the axes of the world
        tx_positions = [[0, 0.1, 0]]  # about each position, in the radar frame
        rx_positions = [[0, -0.1, 0]]
        range_origin = -0.45          # what cables add to all ranges is taken off

    That of a phase history, whose values may be names of variables of the data file::

        frame = 2

        [data]
        file = "pass.mat"             # or .npy, .npz, .h5, .hdf5
        variable = "data.fp"
        dimensions = ["sample", "frame"]
        conjugate = true              # phases fall with delay, exp(−2πj f τ)

        [sweep]
        frequencies = "data.freq"     # or start_frequency and step

        [radar]
        positions = ["data.x", "data.y", "data.z"]
        range_origin = "data.r0"      # of every frame; or range_center = [0.0, 0.0, 0.0]

    ``range_origin`` and ``range_center`` are those of `Radar`: what has range 0 in the data, by
    motion compensation. Names that end in .csv or .npy are files beside the description.

    Args:
        path: the file.
        trusted: read HDF5 and MATLAB files in this process, not in a child process.

    Raises:
        InputError: no file, a damaged one, unknown or missing keys, files that do not fit each
            other, or frequencies that are not equally spaced.
    """
    path = Path(path)
    description: dict[str, dict[str, Any]] = {"data": {"file": path.name}}
    axes = [0, 1, 2]
    if not TOUCHSTONE.fullmatch(path.suffix):
        description, axes = described_arrays.load_description(path, _KEYS)
    data, sweep, radar = (description.get(name, {}) for name in ("data", "sweep", "radar"))
    files = _find_data_files(path, data)
    origin = [[0.0, 0.0, 0.0]]
    tx = described_arrays.element_array(radar.get("tx_positions", origin), "TX", axes)
    rx = described_arrays.element_array(radar.get("rx_positions", origin), "RX", axes)
    source = _SweepFile(files[0], trusted)
    if TOUCHSTONE.fullmatch(files[0].suffix):
        frequencies, beat = _load_touchstone_sweeps(files, sweep, path)
    else:
        beat = _load_sweep_array(files, data, len(tx.positions), trusted)
        frequencies = _load_frequencies(source, sweep, beat.shape[-1])
    frequencies, order = frequencies.sort(stable=True)
    frequencies, beat = _select_band(frequencies, beat[..., order], sweep.get("band"))
    start, step = _frequency_spacing(frequencies)
    waveform = SteppedFrequency(start, step, len(frequencies), sweep.get("dwell", _DWELL))
    places = _load_positions(source, radar.get("positions"), len(beat))[:, axes]
    toward, center = (_parse_point(radar, name, axes) for name in ("look_at", "range_center"))
    device = Radar(tx, rx, waveform, places, None if toward is None else look_at(places, toward))
    return Capture.from_beat(beat, _set_range_origin(device, source, radar, center))


def _select_band(frequencies: _Frequencies, beat: Tensor, band: Any) -> tuple[Tensor, Tensor]:
    """Select the frequencies within a band [Hz], and their samples."""
    if band is None:
        return frequencies, beat
    if not isinstance(band, list) or len(band) != 2 or not float(band[0]) < float(band[1]):
        raise refusal("described_sweeps.band", band)
    inside = (frequencies >= band[0]) & (frequencies <= band[1])
    if inside.sum() < 2:
        raise refusal("described_sweeps.empty_band", frequencies.min(), frequencies.max(), band)
    return frequencies[inside], beat[..., inside]


def _load_sweep_array(
    files: list[Path], data: dict[str, Any], tx_count: int, trusted: bool
) -> Tensor:
    """Load the sweeps of an array file, [frame, tx, rx, sample]."""
    if len(files) > 1:
        raise refusal("described_sweeps.several_files", len(files), files[0].name)
    array = described_arrays.load_array(files[0], data.get("variable"), trusted=trusted)
    order = data.get("dimensions", ["frame", "tx", "rx", "sample"])
    samples = torch.from_numpy(described_arrays.arrange_dimensions(array, order, tx_count))
    if samples.shape[1] != 1:
        raise refusal("described_sweeps.several_chirps", samples.shape[1])
    return (samples[:, 0].conj() if data.get("conjugate", False) else samples[:, 0]).resolve_conj()


@dataclass(frozen=True)
class _SweepFile:
    """The arrays that a description names: in its data file, or in files beside it."""

    file: Path
    trusted: bool

    def values(self, given: Any) -> Any:
        """Numbers as they are given, or those of the name."""
        if not isinstance(given, str):
            return given
        beside = untrusted.named_file(self.file, given)
        if beside.suffix == ".npy":
            return untrusted.read_npy(beside)
        if TOUCHSTONE.fullmatch(self.file.suffix) or self.file.suffix == ".npy":
            raise refusal("described_sweeps.no_variables", given, self.file.name)
        return described_arrays.load_array(self.file, given, trusted=self.trusted)


def _find_data_files(path: Path, data: dict[str, Any]) -> list[Path]:
    """The data files of a description, at least one."""
    if ("file" in data) == ("files" in data):
        raise refusal("described_sweeps.files", "both" if data else "neither")
    if "file" in data:
        return [untrusted.named_file(path, str(data["file"]))]
    named = data["files"]
    if isinstance(named, str):
        # Of names, not of folders: those may be many, or links.
        pattern = untrusted.named_file(path, named)
        matches = pattern.parent.glob(pattern.name)
        named = sorted(str(file.relative_to(path.parent)) for file in matches)
    found = [untrusted.named_file(path, str(name)) for name in named]
    if not found:
        raise InputError(f"expected files {data['files']!r} beside {path}, got none; check them")
    return found


def _load_touchstone_sweeps(
    files: list[Path], sweep: dict[str, Any], path: Path
) -> tuple[_Frequencies, Complex128[Tensor, "frame 1 1 sample"]]:
    """Frequencies, and the beat signal of every file less the background."""
    frequencies, first = _load_parameter(files[0], sweep)
    rows = [first, *(_load_response(file, sweep, frequencies) for file in files[1:])]
    response = torch.stack(rows)
    if "background" in sweep:
        empty = untrusted.named_file(path, str(sweep["background"]))
        response = response - _load_response(empty, sweep, frequencies)
    # The beat signal is conj(H), as that of OFDM.
    return frequencies, response.conj().resolve_conj()[:, None, None]


def _load_parameter(file: Path, sweep: dict[str, Any]) -> tuple[Tensor, Tensor]:
    """Frequencies of a Touchstone file, and one of its scattering parameters."""
    found = load_touchstone(file)
    ports = found.parameters.shape[1]
    name = str(sweep.get("parameter", "S11" if ports == 1 else "S21"))
    match = _PARAMETER.fullmatch(name)
    out, into = (int(port) for port in match.groups()) if match else (0, 0)
    if not (1 <= out <= ports and 1 <= into <= ports):
        raise refusal("described_sweeps.parameter", ports, file.name, name)
    return found.frequencies, found.parameters[:, out - 1, into - 1]


def _load_response(file: Path, sweep: dict[str, Any], frequencies: Tensor) -> Tensor:
    """The response of a file, if it was swept over the same frequencies."""
    own, response = _load_parameter(file, sweep)
    if len(own) != len(frequencies) or bool(((own - frequencies).abs() > 1e-9 * own).any()):
        raise refusal(
            "described_sweeps.unlike_sweeps", len(frequencies), file.name, len(own), own[0], own[-1]
        )
    return response


def _load_frequencies(source: _SweepFile, sweep: dict[str, Any], samples: int) -> _Frequencies:
    """Frequencies of the samples of a phase history."""
    if "frequencies" in sweep:
        given = np.ravel(source.values(sweep["frequencies"]))
        return checked_tensor(given, (samples,), "frequencies", "give one in Hz per sample")
    if not {"start_frequency", "step"} <= set(sweep):
        raise refusal("described_sweeps.no_frequencies")
    count = torch.arange(samples, dtype=torch.float64)
    return float(sweep["start_frequency"]) + float(sweep["step"]) * count


def _frequency_spacing(frequencies: _Frequencies) -> tuple[float, float]:
    """First frequency and step of equally spaced ones [Hz]."""
    count = len(frequencies)
    if count < 2:
        raise refusal("described_sweeps.few_frequencies", count)
    first = float(frequencies[0])
    step = (float(frequencies[-1]) - first) / (count - 1)
    line = first + step * torch.arange(count, dtype=torch.float64)
    if not (step > 0 and (frequencies - line).abs().max() <= _SPACING_TOLERANCE * step):
        steps = frequencies.diff()
        raise refusal("described_sweeps.spacing", float(steps.min()), float(steps.max()))
    return first, step


def _load_positions(source: _SweepFile, given: Any, frames: int) -> Float64[Tensor, "frame 3"]:
    """The radar's position in every frame."""
    if given is None and frames > 1:
        raise refusal("described_sweeps.no_positions", frames)
    if given is None:
        return torch.zeros(1, 3, dtype=torch.float64)
    if isinstance(given, str) and given.lower().endswith(".csv"):
        given = _read_position_rows(untrusted.named_file(source.file, given))
    elif isinstance(given, list) and any(isinstance(name, str) for name in given):
        given = np.stack([np.ravel(source.values(name)) for name in given], axis=-1)
    do = "give x, y, z in metres of every frame"
    return checked_tensor(source.values(given), (frames, 3), "positions in [radar]", do)


def _read_position_rows(file: Path) -> list[list[float]]:
    """x, y, z of a CSV file whose first line says which column is which."""
    what = "lines of x,y,z [m] after a line of these heads"
    text = untrusted.read_text(file, what)
    with untrusted.convert_read_errors(file, what, "begin with a line x,y,z"):
        head, *lines = text.splitlines()
        mark = next((m for m in ";\t" if m in head), ",")
        if mark == ";":  # where commas are decimal marks
            lines = [line.replace(",", ".") for line in lines]
        heads = (name.strip() for name in head.split(mark))
        names = [re.sub(r"[\[(]m[\])]$", "", name).strip().lower() for name in heads]
        table = csv.DictReader(lines, names, delimiter=mark)
        return [[float(row[axis]) for axis in "xyz"] for row in table]


def _parse_point(radar: dict[str, Any], name: str, axes: list[int]) -> Float64[Tensor, "3"] | None:
    """A point in the world that a description may state."""
    if name not in radar:
        return None
    return checked_tensor(radar[name], (3,), f"{name} in [radar]", "give x, y, z in metres")[axes]


def _set_range_origin(
    device: Radar, source: _SweepFile, radar: dict[str, Any], center: Tensor | None
) -> Radar:
    """The radar with the range origin of its data."""
    if "range_origin" in radar and center is not None:
        raise InputError("expected range_origin or range_center in [radar], got both; remove one")
    if center is not None:
        return device.center_on(center)
    if "range_origin" not in radar:
        return device
    given = np.ravel(source.values(radar["range_origin"])).astype(float)
    if given.size == 1:
        given = np.full(device.frame_count, given[0])
    do = "give one range in metres, or one per frame"
    origin = checked_tensor(given, (device.frame_count,), "range_origin in [radar]", do)
    return replace(device, range_origin=origin)
