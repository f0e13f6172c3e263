"""`invertwin rcs`: radar signatures of scenes, beside what is known or was measured."""

import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from invertwin import plotting
from invertwin.capture import load_section
from invertwin.cli.estimate import of_signature
from invertwin.cli.report import Picture, Table, finish, picture, texts
from invertwin.cli.schema import RunFile, build
from invertwin.cli.schema.run_file import about, need
from invertwin.cli.schema.signature import Measurement, Rcs
from invertwin.cli.terminal import in_parts
from invertwin.errors import InputError
from invertwin.scene import Scene
from invertwin.signatures import Signature, decibels
from invertwin.storage.run_folder import RunFolder

_NOTHING = -200.0  # dBsm that rounding leaves where there is no field
_SAME = 1e-6  # rad or share of the frequency by which a measured row may be off a swept one
_MOST_PANELS = 4
_Found = dict[str, Any]


def run_rcs(
    runs: Mapping[str, RunFile],
    files: Mapping[str, Path],
    folder: RunFolder,
    say: Callable[[str], None],
) -> list[Table]:
    """Compute every run file's signature, write the folder, and return the tables to print."""
    begin = time.perf_counter()
    scenes: dict[str, _Found] = {}
    pictures: list[Picture] = []

    def compute(name: str, run: RunFile) -> _Found:
        say(name)
        return _signature(name, run, folder)

    for name, run, found in in_parts(runs, files, folder, compute):
        scenes[name] = found
        for file, title in found.pop("pictures").items():
            title = title if len(runs) == 1 else f"{name}: {title}"
            pictures.append(Picture(title, folder.file(f"{file}.png").read_bytes(), run.note))
    metrics = {"task": "rcs", "scenes": scenes, "wall_seconds": time.perf_counter() - begin}
    if len(scenes) == 1:
        metrics |= next(iter(scenes.values()))
    # Beside the scenes, so that every run file has a table of its own name.
    metrics |= {name: found for name, found in scenes.items() if name not in metrics}
    status = ("1 target" if len(scenes) == 1 else f"{len(scenes)} targets") + " computed."
    skipped = [file for found in scenes.values() for file in found.get("skipped", ())]
    if skipped:
        missing = f"{len(skipped)} measured files are not there, such as {skipped[0]}"
        warnings.warn(
            f"skipped a comparison: {missing}; get the data and set INVERTWIN_DATA",
            UserWarning,
            stacklevel=2,
        )
        status += f" Skipped a comparison: {missing}."
    return finish(
        folder, metrics, "Radar signatures", status, [*_tables(scenes), *pictures], again="rcs"
    )


def _signature(name: str, run: RunFile, folder: RunFolder) -> _Found:
    begin = time.perf_counter()
    table: Rcs = need(run, "rcs", "rcs")
    scene = build.scene(run)
    of_signature(run, scene).require()
    with about("rcs"):
        found = table.build({Scene: scene})
    kept: _Found = {
        "peak_dbsm": {
            channel: _level(found.dbsm[:, :, i, j]) for channel, (i, j) in table.channels.items()
        }
    }
    if table.cases:
        kept["error_db"] = {case: _error(table, case, found) for case in table.cases}
    measured, skipped = _measured(table, found)
    if measured:
        kept["mean_db"] = {key: _mean(found.dbsm, *rest) for key, rest in measured.items()}
        optics = [v for part, v in found.parts.items() if part.startswith("order")]
        alone = decibels(torch.stack(optics).sum(0))
        kept["mean_db_optics"] = {key: _mean(alone, *rest) for key, rest in measured.items()}
    if skipped:
        kept["skipped"] = skipped
    folder.write_text(f"{name}.csv", _rows(table, found))
    kept["pictures"] = _pictures(name, table, found, measured, folder)
    return kept | {"seconds": time.perf_counter() - begin}


def _level(levels: Tensor) -> float | None:
    """The largest, unless it is none."""
    level = float(levels.max())
    return level if level > _NOTHING else None


def _error(table: Rcs, name: str, found: Signature) -> float:
    """How far a case is from what it should be, in dB."""
    case = table.cases[name]
    with about(f"rcs.cases.{name}"):
        if case.part is not None and case.part not in found.parts:
            raise InputError(
                f"expected a part ({', '.join(found.parts)}), got {case.part}; choose one", "part"
            )
        oracle = case.reference.build()
    whole = found.matrix if case.part is None else found.parts[case.part]
    i, j = table.channels[case.channel]
    truth = 10 * torch.log10(oracle.section(found.frequencies, found.directions))
    error = decibels(whole[:, :, i, j]) - truth
    return float(error.square().mean().sqrt() if case.statistic == "rms" else error.abs().max())


_Rows = tuple[Tensor, Tensor, Tensor, tuple[int, int]]  # frequency, aspect, level, channel


def _measured(table: Rcs, found: Signature) -> tuple[dict[str, _Rows], list[str]]:
    """Measured rows that were swept, by frequency and polarisation; and what is not there."""
    rows: dict[str, _Rows] = {}
    skipped: list[str] = []
    for number, measurement in enumerate(table.measured):
        if not Path(measurement.file).exists():
            skipped.append(measurement.file)
            continue
        with about(f"rcs.measured[{number}]"):
            rows |= _of_file(table, measurement, found)
    return rows, skipped


def _of_file(table: Rcs, measurement: Measurement, found: Signature) -> dict[str, _Rows]:
    data = load_section(measurement.file)
    towards = torch.stack(
        [data.theta.sin() * data.phi.cos(), data.theta.sin() * data.phi.sin(), data.theta.cos()], 1
    )
    apart = torch.cdist(towards, found.directions)
    off, aspect = apart.min(1)
    share = (data.frequency[:, None] / found.frequencies - 1).abs()
    other, frequency = share.min(1)
    same = (off < _SAME) & (other < _SAME)
    if not bool(same.any()):
        raise InputError(
            f"expected rows of swept angles and frequencies, got none of {len(same)} in "
            f"{measurement.file}; sweep its angles",
            "file",
        )
    channel = table.channels[measurement.channel]
    keys: dict[str, _Rows] = {}
    for f in frequency[same].unique().tolist():
        own = same & (frequency == f)
        letter = (
            measurement.channel[0] if len(set(measurement.channel)) == 1 else (measurement.channel)
        )
        name = f"{float(found.frequencies[f]) / 1e9:g}GHz_{letter}"
        keys[name] = (frequency[own], aspect[own], data.dbsm[own], channel)
    return keys


def _mean(
    levels: Tensor, frequency: Tensor, aspect: Tensor, measured: Tensor, channel: tuple[int, int]
) -> float:
    """Mean absolute difference from the measurement in dB."""
    return float((levels[frequency, aspect, channel[0], channel[1]] - measured).abs().mean())


def _pictures(
    name: str, table: Rcs, found: Signature, measured: Mapping[str, _Rows], folder: RunFolder
) -> dict[str, str]:
    """Draw what was found; file names and titles."""
    shown = {name: "Radar cross-section"}
    angles, label = table.angles
    first, *_, second = table.channels.values()
    names = {at: channel for channel, at in table.channels.items()}
    levels = found.dbsm
    panels: dict[str, dict[str, Tensor]] = {}
    if len(angles) > 1:
        for f, frequency in enumerate(found.frequencies.tolist()[:_MOST_PANELS]):
            curves = {names[at]: levels[f, :, at[0], at[1]] for at in (first, second)}
            for rows in measured.values():
                if int(rows[0][0]) == f:
                    line = torch.full((len(angles),), torch.nan, dtype=torch.float64)
                    line[rows[1]] = rows[2]
                    curves[f"measured {names[rows[3]]}"] = line
            panels[f"{frequency / 1e9:g} GHz"] = curves
        figure = plotting.sections(panels, angles, label)
    else:
        panels[""] = {names[at]: levels[:, 0, at[0], at[1]] for at in (first, second)}
        figure = plotting.sections(panels, found.frequencies / 1e9, "frequency [GHz]")
    picture(folder, name, figure)
    if table.profile:
        with about("rcs.profile"):
            ranges, profile = found.range_profile()
        figure = plotting.profile(decibels(profile[..., 0, 0]), ranges, angles, label)
        picture(folder, f"{name}_profile", figure)
        shown[f"{name}_profile"] = f"Range profile, {names[first]}"
    if table.image is not None:
        side = table.image
        axes = _plane(found)
        steps = torch.linspace(-side.extent, side.extent, side.pixels, dtype=torch.float64)
        across, along = torch.meshgrid(steps, steps, indexing="xy")
        points = across[..., None] * axes[1] + along[..., None] * axes[0]
        figure = plotting.focused(
            decibels(found.image(points)[..., 0, 0]),
            side.extent,
            ("across [m]", "towards the middle aspect [m]"),
        )
        picture(folder, f"{name}_image", figure)
        shown[f"{name}_image"] = f"Image, {names[first]}"
    return shown


def _plane(found: Signature) -> tuple[Tensor, Tensor]:
    """Unit vectors towards the middle of the sweep, and across in its plane."""
    middle = found.directions[len(found.directions) // 2]
    across = found.directions[-1] - found.directions[0]
    across = across - (across @ middle) * middle
    if float(across.norm()) < _SAME:
        raise InputError(
            "expected several aspects for an image, got one direction; sweep an angle",
            "rcs.image",
        )
    return middle, across / across.norm()


def _rows(table: Rcs, found: Signature) -> str:
    """All of S as text."""
    names = list(table.channels)
    lines = ["frequency_hz,x,y,z," + ",".join(f"{n}_re_m,{n}_im_m" for n in names)]
    matrix = found.matrix
    for f, frequency in enumerate(found.frequencies.tolist()):
        for a, direction in enumerate(found.directions.tolist()):
            values = [matrix[f, a, i, j] for i, j in table.channels.values()]
            cells = [f"{float(v.real):.9e},{float(v.imag):.9e}" for v in values]
            lines.append(
                f"{frequency:.9e},"
                + ",".join(f"{c:.9f}" for c in direction)
                + ","
                + ",".join(cells)
            )
    return "\n".join(lines) + "\n"


def _tables(scenes: Mapping[str, _Found]) -> list[Table]:
    peaks = [[name, *found["peak_dbsm"].values()] for name, found in scenes.items()]
    letters = {tuple(found["peak_dbsm"]) for found in scenes.values()}
    columns = letters.pop() if len(letters) == 1 else ("co-polar", "cross", "cross", "orthogonal")
    note = texts("notes")["rcs_peaks"]
    tables = [Table("Peaks [dBsm]", ["target", *columns], peaks, note)]
    cases = [
        [name, case, error]
        for name, found in scenes.items()
        for case, error in found.get("error_db", {}).items()
    ]
    if cases:
        note = texts("notes")["rcs_cases"]
        tables.append(Table("Against what is known", ["target", "case", "error [dB]"], cases, note))
    rows = [
        [name, key, error, found["mean_db_optics"][key]]
        for name, found in scenes.items()
        for key, error in found.get("mean_db", {}).items()
    ]
    if rows:
        columns = ["target", "frequency, polarisation", "mean error [dB]", "physical optics alone"]
        note = texts("notes")["rcs_measured"]
        tables.append(Table("Against measurements", columns, rows, note))
    return tables
