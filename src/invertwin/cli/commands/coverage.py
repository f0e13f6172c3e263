"""`invertwin simulate` without a radar: levels that transmitters reach, as a coverage map."""

import io
import time
from typing import Any

import numpy as np
import torch

from invertwin import plotting
from invertwin.cli.fits.received_levels import radio_map, require_drawn_places
from invertwin.cli.report import ReportTable, quantity_table, save_picture, write_report
from invertwin.cli.run_file import prefix_errors, require_section
from invertwin.cli.schema import RunFile, build
from invertwin.links import MapPlane
from invertwin.storage.run_folder import RunFolder


def run_coverage(run: RunFile, folder: RunFolder) -> tuple[list[ReportTable], str]:
    """Compute the map of a run file, write the folder, return tables and a sentence to print."""
    begin, scene = time.perf_counter(), build.true_scene(run)
    model = radio_map(run, None)
    with prefix_errors("transmitter"):
        sensor = require_section(run, "transmitter", "a coverage map").build()
    places, unit = require_drawn_places(model), model.unit
    with torch.no_grad():
        values = model.predict(scene, sensor, run.seed)
    at = places.centres.reshape(-1, 3) if isinstance(places, MapPlane) else places.positions
    table = io.BytesIO()
    heads = ",".join(["x,y,z", *(f"transmitter_{k + 1}" for k in range(len(values)))])
    rows = torch.cat([at, values.flatten(1).T], 1).numpy()
    np.savetxt(table, rows, "%.9g", ",", header=heads, comments="")
    folder.write_bytes("map.csv", table.getvalue())
    best = values.amax(0).flatten()
    ends = best.quantile(torch.tensor([0.5, 0.1, 1.0]).double()).tolist()
    median, tenth, largest = (f"{value:.3g} {unit}" for value in ends)
    name = model.quantity.replace("_", " ").capitalize()
    metrics: dict[str, Any] = {
        "task": "simulate",
        "answer": f"{name}{' of the best transmitter' * (len(values) > 1)} at {len(best)} places: "
        f"median {median}, a tenth below {tenth}, largest {largest}",
        **dict(zip(("median", "tenth", "largest"), ends, strict=True)),
        "wall_seconds": time.perf_counter() - begin,
    }
    parts: list[Any] = [quantity_table(f"{name} [{unit}]", metrics, label_table="coverage")]
    if isinstance(places, MapPlane):
        maps = {f"transmitter {k}": one for k, one in enumerate(values, 1)}
        look: Any = {"transmitters": sensor, "label": f"{name} [{unit}]"}
        figure = plotting.coverage(maps, places, scene=scene, **look)
        parts.insert(0, save_picture(folder, "coverage", figure, "Coverage"))
    title, status = run.title or "Coverage", f"{metrics['answer']}."
    tables = write_report(folder, metrics, title, status, parts, again="simulate", note=run.note)
    return tables, metrics["answer"]
