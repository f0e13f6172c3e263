"""`invertwin rcs`: radar signatures of scenes, beside known or measured values."""

import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from invertwin import plotting
from invertwin.capture import load_rcs
from invertwin.cli.estimate import estimate_rcs_resources
from invertwin.cli.report import ReportPicture, ReportTable, load_texts, save_picture, write_report
from invertwin.cli.run_file import prefix_errors, require_section
from invertwin.cli.schema import RunFile, build
from invertwin.cli.schema.signature import RcsMeasurement, RcsTable
from invertwin.cli.terminal import RunBatch
from invertwin.refusals import refusal
from invertwin.scene import Scene
from invertwin.signatures import Signature, aspect_directions, to_dbsm
from invertwin.storage.run_folder import RunFolder

_MIN_LEVEL = -200.0  # dBsm that rounding leaves where there is no field
# Rad, or share of the frequency, by which a measured row may be off a swept one.
_MATCH_TOLERANCE = 1e-6
_MAX_PANELS = 4
_RcsMetrics = dict[str, Any]
_MeasuredRows = tuple[Tensor, Tensor, Tensor, tuple[int, int]]  # frequency, aspect, level, channel
_Measured = Mapping[str, _MeasuredRows]  # by frequency and channel


def run_rcs(batch: RunBatch, say: Callable[[str], None]) -> tuple[list[ReportTable], str]:
    """Compute every run file's signature, write the folder, return tables and a sentence."""
    begin, folder = time.perf_counter(), batch.folder
    scenes: dict[str, _RcsMetrics] = {}
    pictures: list[ReportPicture] = []

    def compute(name: str, run: RunFile) -> _RcsMetrics:
        say(name)
        return _compute_rcs(name, run, folder)

    for name, run, found in batch.results(compute):
        scenes[name] = found
        for file, title in found.pop("pictures").items():
            title = title if len(batch.runs) == 1 else f"{name}: {title}"
            pictures.append(ReportPicture(title, folder.file(f"{file}.png").read_bytes(), run.note))
    answer = "; ".join(f"{name}: peak {_peak(own):.1f} dBsm" for name, own in scenes.items())
    seconds = time.perf_counter() - begin
    metrics = {"task": "rcs", "answer": answer, "scenes": scenes, "wall_seconds": seconds}
    if len(scenes) == 1:
        metrics |= next(iter(scenes.values()))
    # Beside the scenes, so that every run file has a table of its own name.
    metrics |= {name: found for name, found in scenes.items() if name not in metrics}
    status = f"{answer}."
    skipped = [file for found in scenes.values() for file in found.get("skipped", ())]
    if skipped:
        missing = f"{len(skipped)} measured files are not there, such as {skipped[0]}"
        text = f"skipped a comparison: {missing}; get the data and set INVERTWIN_DATA"
        warnings.warn(text, UserWarning, stacklevel=2)
        status += f" Skipped a comparison: {missing}."
    parts = [*pictures[:1], *_make_tables(scenes), *pictures[1:]]
    return write_report(folder, metrics, "Radar signatures", status, parts, again="rcs"), answer


def _peak(found: _RcsMetrics) -> float:
    """Return the largest cross-section over all polarisations [dBsm]."""
    return max((x for x in found["peak_dbsm"].values() if x is not None), default=float("-inf"))


def _compute_rcs(name: str, run: RunFile, folder: RunFolder) -> _RcsMetrics:
    begin = time.perf_counter()
    table: RcsTable = require_section(run, "rcs", "rcs")
    scene = build.scene(run)
    estimate_rcs_resources(run, scene).require_available()
    with prefix_errors("rcs"):
        found = table.build({Scene: scene})
    peaks = {n: float(found.dbsm[:, :, i, j].max()) for n, (i, j) in table.channels.items()}
    peaks = {name: level if level > _MIN_LEVEL else None for name, level in peaks.items()}
    kept: _RcsMetrics = {"peak_dbsm": peaks}
    if table.cases:
        kept["error_db"] = {case: _case_error(table, case, found) for case in table.cases}
    measured: dict[str, _MeasuredRows] = {}
    skipped: list[str] = []
    for number, measurement in enumerate(table.measured):
        if not Path(measurement.file).exists():
            skipped.append(measurement.file)
            continue
        with prefix_errors(f"rcs.measured[{number}]"):
            measured |= _match_measurement(table, measurement, found)
    if measured:
        kept["mean_db"] = _mean_differences(found.dbsm, measured)
        optics = [v for part, v in found.parts.items() if part.startswith("order")]
        kept["mean_db_optics"] = _mean_differences(to_dbsm(torch.stack(optics).sum(0)), measured)
    if skipped:
        kept["skipped"] = skipped
    folder.write_text(f"{name}.csv", _format_csv(table, found))
    kept["pictures"] = _draw_pictures(name, table, found, measured, folder)
    return kept | {"seconds": time.perf_counter() - begin}


def _case_error(table: RcsTable, name: str, found: Signature) -> float:
    """Return the error of a case against its expected value, in dB."""
    case = table.cases[name]
    with prefix_errors(f"rcs.cases.{name}"):
        if case.part is not None and case.part not in found.parts:
            raise refusal("rcs.unknown_part", ", ".join(found.parts), case.part, at="part")
        oracle = case.reference.build()
    whole = found.matrix if case.part is None else found.parts[case.part]
    i, j = table.channels[case.channel]
    truth = 10 * torch.log10(oracle.section(found.frequencies, found.directions))
    error = to_dbsm(whole[:, :, i, j]) - truth
    return float(error.square().mean().sqrt() if case.statistic == "rms" else error.abs().max())


def _match_measurement(
    table: RcsTable, measurement: RcsMeasurement, found: Signature
) -> dict[str, _MeasuredRows]:
    data = load_rcs(measurement.file)
    towards = aspect_directions(data.theta, data.phi)
    off, aspect = torch.cdist(towards, found.directions).min(1)
    other, frequency = (data.frequency[:, None] / found.frequencies - 1).abs().min(1)
    same = (off < _MATCH_TOLERANCE) & (other < _MATCH_TOLERANCE)
    if not bool(same.any()):
        raise refusal("rcs.unswept_rows", len(same), measurement.file, at="file")
    stated = measurement.channel
    channel, letter = table.channels[stated], stated[0] if len(set(stated)) == 1 else stated
    keys: dict[str, _MeasuredRows] = {}
    for f in frequency[same].unique().tolist():
        own = same & (frequency == f)
        name = f"{float(found.frequencies[f]) / 1e9:g}GHz_{letter}"
        keys[name] = (frequency[own], aspect[own], data.dbsm[own], channel)
    return keys


def _mean_differences(levels: Tensor, measured: _Measured) -> dict[str, float]:
    """Mean absolute differences from the measurements in dB."""
    return {
        key: float((levels[frequency, aspect, i, j] - known).abs().mean())
        for key, (frequency, aspect, known, (i, j)) in measured.items()
    }


def _draw_pictures(
    name: str, table: RcsTable, found: Signature, measured: _Measured, folder: RunFolder
) -> dict[str, str]:
    """Draw the results; return file names and titles."""
    shown = {name: "Radar cross-section"}
    angles, label = table.swept_angles
    first, *_, second = table.channels.values()
    names = {at: channel for channel, at in table.channels.items()}
    levels = found.dbsm
    panels: dict[str, dict[str, Tensor]] = {}
    if len(angles) > 1:
        for f, frequency in enumerate(found.frequencies.tolist()[:_MAX_PANELS]):
            curves = {names[at]: levels[f, :, at[0], at[1]] for at in (first, second)}
            for rows in measured.values():
                if int(rows[0][0]) == f:
                    line = torch.full((len(angles),), torch.nan, dtype=torch.float64)
                    line[rows[1]] = rows[2]
                    curves[f"measured {names[rows[3]]}"] = line
            panels[f"{frequency / 1e9:g} GHz"] = curves
        figure = plotting.rcs_curves(panels, angles, label)
    else:
        panels[""] = {names[at]: levels[:, 0, at[0], at[1]] for at in (first, second)}
        figure = plotting.rcs_curves(panels, found.frequencies / 1e9, "frequency [GHz]")
    save_picture(folder, name, figure)
    if table.profile:
        with prefix_errors("rcs.profile"):
            ranges, profile = found.range_profile()
        figure = plotting.rcs_profile(to_dbsm(profile[..., 0, 0]), ranges, angles, label)
        save_picture(folder, f"{name}_profile", figure)
        shown[f"{name}_profile"] = f"Range profile, {names[first]}"
    if table.image is not None:
        side = table.image
        axes = _image_axes(found)
        steps = torch.linspace(-side.extent, side.extent, side.pixels, dtype=torch.float64)
        across, along = torch.meshgrid(steps, steps, indexing="xy")
        points = across[..., None] * axes[1] + along[..., None] * axes[0]
        drawn, labels = found.image(points), ("across [m]", "towards the middle aspect [m]")
        figure = plotting.rcs_image(to_dbsm(drawn[..., 0, 0]), side.extent, labels)
        save_picture(folder, f"{name}_image", figure)
        shown[f"{name}_image"] = f"Image, {names[first]}"
    return shown


def _image_axes(found: Signature) -> tuple[Tensor, Tensor]:
    """Unit vectors towards the middle of the sweep, and across in its plane."""
    middle = found.directions[len(found.directions) // 2]
    across = found.directions[-1] - found.directions[0]
    across = across - (across @ middle) * middle
    if float(across.norm()) < _MATCH_TOLERANCE:
        raise refusal("rcs.one_aspect", at="rcs.image")
    return middle, across / across.norm()


def _format_csv(table: RcsTable, found: Signature) -> str:
    """Format the whole scattering matrix S as CSV text."""
    lines = ["frequency_hz,x,y,z," + ",".join(f"{n}_re_m,{n}_im_m" for n in table.channels)]
    matrix = found.matrix
    for f, frequency in enumerate(found.frequencies.tolist()):
        for a, direction in enumerate(found.directions.tolist()):
            values = [matrix[f, a, i, j] for i, j in table.channels.values()]
            cells = [f"{frequency:.9e}", *(f"{c:.9f}" for c in direction)]
            cells += [f"{float(v.real):.9e},{float(v.imag):.9e}" for v in values]
            lines.append(",".join(cells))
    return "\n".join(lines) + "\n"


def _make_tables(scenes: Mapping[str, _RcsMetrics]) -> list[ReportTable]:
    peaks = [[name, *found["peak_dbsm"].values()] for name, found in scenes.items()]
    letters = {tuple(found["peak_dbsm"]) for found in scenes.values()}
    columns = letters.pop() if len(letters) == 1 else ("co-polar", "cross", "cross", "orthogonal")
    notes = load_texts("notes")
    tables = [ReportTable("Peaks [dBsm]", ["target", *columns], peaks, notes["rcs_peaks"])]
    cases = _rows_of(scenes, "error_db")
    if cases:
        columns = ["target", "case", "error [dB]"]
        tables.append(ReportTable("Against what is known", columns, cases, notes["rcs_cases"]))
    optics = {name: found.get("mean_db_optics", {}) for name, found in scenes.items()}
    rows = [[name, key, mean, optics[name][key]] for name, key, mean in _rows_of(scenes, "mean_db")]
    if rows:
        columns = ["target", "frequency, polarisation", "mean error [dB]", "physical optics alone"]
        tables.append(ReportTable("Against measurements", columns, rows, notes["rcs_measured"]))
    return tables


def _rows_of(scenes: Mapping[str, _RcsMetrics], key: str) -> list[list[Any]]:
    """Name of the scene, name of the value, and the value."""
    return [[name, *item] for name, own in scenes.items() for item in own.get(key, {}).items()]
