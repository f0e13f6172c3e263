"""`invertwin train-prior`: a shape prior trained on cars of the generator."""

import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from invertwin.cli.report import ReportPicture, ReportTable, report_html
from invertwin.plotting import PALETTE, png_bytes
from invertwin.scene import Mesh, ShapePrior, load_prior
from invertwin.storage.run_folder import RunFolder
from invertwin_studies.prior_training import Trained, Training, train_prior

_SHOWN = 4  # coordinates of the picture
_STEPS = (-2.0, -1.0, 0.0, 1.0, 2.0)  # standard deviations of the picture
_LABELS = {
    "cars": "cars of the training",
    "latent": "coordinates of a shape",
    "train_error_m": "error near the surface, cars of the training [m]",
    "held_out_error_m": "error near the surface, other cars at their best latents [m]",
    "mean_error_m": "error near the surface, other cars, mean shape [m]",
    "decode_64_s": "a field of 64³ nodes [s]",
    "file_mb": "prior.npz [MB]",
    "seconds": "time [s]",
}


def run_train_prior(
    settings: Training, folder: RunFolder, again: str, say: Callable[[str], None]
) -> list[ReportTable]:
    """Trains a prior and writes it with its log, numbers and pictures.

    Args:
        settings: Of the training.
        folder: Where results go: prior.npz, train.log, metrics.json, report.html.
        again: The command that does the same.
        say: Takes a line of the log as it comes.
    """
    lines: list[str] = []

    def log(line: str) -> None:
        lines.append(line)
        say(line)

    begun = time.monotonic()
    trained = train_prior(settings, log)
    file = folder.file("prior.npz")
    trained.prior.save(file)
    # As users get it: numbers of half precision.
    prior = load_prior(file)
    metrics = {
        "cars": settings.cars,
        "latent": settings.latent,
        "train_error_m": trained.history[-1]["error"],
        "held_out_error_m": trained.held_out_error,
        "mean_error_m": trained.mean_error,
        "decode_64_s": _decoding_time(prior),
        "file_mb": os.path.getsize(file) / 1e6,
        "seconds": time.monotonic() - begun,
    }
    folder.write_text("train.log", "\n".join(lines) + "\n")
    folder.write_json("metrics.json", {**metrics, "history": trained.history})
    table = ReportTable(
        "Shape prior",
        ["quantity", "value"],
        [[label, metrics[key]] for key, label in _LABELS.items()],
        "Errors are root mean squares of distances, weighted by closeness to the surface.",
    )
    pictures = [
        ReportPicture("Learning", png_bytes(_curve(trained))),
        ReportPicture(
            "What the coordinates do",
            png_bytes(_gallery(prior)),
            "From the side and from above: one coordinate a row, in standard deviations; the "
            "mean shape is in the middle.",
        ),
    ]
    status = (
        f"{settings.cars} cars, {settings.latent} coordinates: held-out cars are "
        f"{100 * trained.held_out_error:.1f} cm off, {100 * trained.mean_error:.1f} cm at the mean."
    )
    note = f"Seed {settings.seed}; the log is train.log, the model prior.npz."
    html = report_html("Shape prior of vehicles", status, note, [table, *pictures], again, {})
    folder.write_text("report.html", html)
    return [table]


def _decoding_time(prior: ShapePrior) -> float:
    begun = time.perf_counter()
    prior.decode(torch.zeros(prior.latent_size, dtype=torch.float64), (64, 64, 64))
    return time.perf_counter() - begun


def _curve(trained: Trained) -> Figure:
    figure = Figure(figsize=(7, 3), layout="constrained")
    axes = figure.subplots()
    rows: list[dict[str, Any]] = trained.history
    axes.plot([row["epoch"] for row in rows], [row["error"] for row in rows], color=PALETTE[0])
    axes.axhline(trained.held_out_error, color=PALETTE[1], label="held out, at the end")
    axes.set(xlabel="epoch", ylabel="error near the surface [m]")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure


def _gallery(prior: ShapePrior) -> Figure:
    rows = min(_SHOWN, prior.latent_size)
    figure = Figure(figsize=(11, 1.9 * rows), layout="constrained")
    grid = figure.subplots(2 * rows, len(_STEPS), squeeze=False)
    for row in range(rows):
        for column, step in enumerate(_STEPS):
            latent = torch.zeros(prior.latent_size, dtype=torch.float64)
            latent[row] = step
            mesh = prior.mesh(latent)
            for axes, up in zip(grid[2 * row : 2 * row + 2, column], (2, 1), strict=True):
                _view(axes, mesh, up)
            grid[2 * row, column].set_title(f"z{row + 1} = {step:+g}", fontsize=8)
    return figure


def _view(axes, mesh: Mesh, up: int) -> None:
    """The triangles that face the eye, seen from the right (up = z) or from above (up = y)."""
    vertices, faces = mesh.vertices.numpy(), mesh.faces.numpy()
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-12)
    towards = -normals[:, 1] if up == 2 else normals[:, 2]
    seen = towards > 0.02
    light = np.abs(normals @ np.array([0.35, -0.55, 0.75]))[seen]
    axes.tripcolor(
        vertices[:, 0], vertices[:, up], faces[seen], light, cmap="gray", vmin=-0.2, vmax=1.0
    )
    axes.set_aspect("equal")
    axes.set_axis_off()
