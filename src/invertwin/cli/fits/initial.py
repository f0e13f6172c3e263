"""The start of a fit by conventional processing, and what the fit has added to it."""

import time
from dataclasses import replace
from typing import Any

from rich.console import Console

from invertwin.cli import build
from invertwin.cli.fits.problem import Problem
from invertwin.cli.run_file import about
from invertwin.cli.schema import Initial
from invertwin.errors import InputError
from invertwin.inversion.initial import (
    Ground,
    best_pose,
    detected_points,
    fit_rectangle,
    guess_density,
    guess_poses,
    guess_position,
    guess_scale,
    image_points,
    largest_group,
    principal_rectangle,
)
from invertwin.radar.surrogate import Surrogate
from invertwin.scene import Mesh, Scene, rigid

# Wide enough for a guess that is off by a cell, sharp enough to tell front from back.
_KERNELS = Surrogate(range_width=1.0, angle_width=0.5)


def guessed(problem: Problem, console: Console) -> tuple[Problem, dict[str, Any]]:
    """The problem with its object where `[initial]` finds it, and how that went.

    Raises:
        InputError: `[starts]` beside it, no echoes, or too few points.
    """
    table = problem.run.initial
    if table is None:
        return problem, {}
    if problem.run.starts is not None:
        raise InputError(
            "initial: expected no [starts] beside [initial], got both; a fit starts from one"
        )
    console.print(f"looking for {table.object} with a conventional detector")
    begin = time.perf_counter()
    with about("initial"):
        scene, found = problem.scene, {}
        if table.low is not None and table.high is not None:
            scene, found = _placed(problem, table, table.low, table.high)
        scene = _clouded(problem, table, scene)
    found["initial_seconds"] = time.perf_counter() - begin
    return replace(problem, scene=scene), found


def _placed(
    problem: Problem, table: Initial, low: list[float], high: list[float]
) -> tuple[Scene, dict[str, Any]]:
    sight = problem.first
    capture, grid, radar = sight.capture, sight.grid, sight.radar
    if table.method == "points":
        points = detected_points(capture, grid, low, high, false_alarm=table.false_alarm)
    else:
        points = image_points(capture, grid, low, high, step=table.step)
    points = largest_group(points, table.gap)
    found: dict[str, Any] = {"initial_points": len(points)}
    plane, scene, name = Ground(table.up), problem.scene, table.object
    item = scene[name]
    if table.pose == "position":
        shift = guess_position(points) - item.center.detach()
        shift[plane.vertical] = 0.0
        return scene.replace(name, pose=rigid(translation=shift) @ item.transform), found
    if table.pose == "axes":
        rectangle = principal_rectangle(points, ground=plane)
    else:
        resolution = radar.waveform.range_resolution
        rectangle = fit_rectangle(points, radar, ground=plane, resolution=resolution)
    if table.scale:
        factor = guess_scale(item, rectangle, ground=plane)
        middle = item.mesh.center
        mesh = Mesh(middle + (item.mesh.vertices - middle) * factor, item.mesh.faces)
        scene = scene.replace(name, mesh=mesh)
        if name in problem.known:
            off = build.residual(scene[name], problem.truth[name])
            found |= {"initial_scale_error": abs(off.scale - 1)} if off else {}
    scene, losses = best_pose(
        scene,
        name,
        guess_poses(scene[name], rectangle, radar, ground=plane),
        radar,
        capture,
        grid,
        loss=build.loss(problem.run.loss),
        surrogate=_KERNELS,
        seed=problem.run.seed,
    )
    return scene, found | {"initial_losses": losses, "initial_size_m": list(rectangle.size)}


def _clouded(problem: Problem, table: Initial, scene: Scene) -> Scene:
    """The scene with a density from the backprojected echoes, where one is sought."""
    for sought in problem.run.parameters:
        if sought.kind == "density" and sought.object == table.object:
            item = scene[table.object]
            grid = guess_density(
                problem.first.capture,
                problem.first.grid,
                item,
                table.object,
                sought.low,
                sought.high,
                sought.counts,
            )
            return scene.replace(table.object, cloud=grid.cloud)
    return scene
