"""The start of a fit by conventional processing."""

import time
from dataclasses import replace
from typing import Any

from rich.console import Console

from invertwin.cli import build
from invertwin.cli.fits.problem import Problem
from invertwin.cli.run_file import about
from invertwin.errors import InputError
from invertwin.inversion.initial import guess_density
from invertwin.inversion.metrics import residual
from invertwin.scene import Scene


def guessed(problem: Problem, console: Console) -> tuple[Problem, dict[str, Any]]:
    """The problem with its object where `[initial]` finds it, and how that went.

    Raises:
        InputError: `[starts]` beside it, no echoes, or too few points.
    """
    run, table, sight = problem.run, problem.run.initial, problem.first
    if table is None:
        return problem, {}
    if run.starts is not None:
        raise InputError(
            "initial: expected no [starts] beside [initial], got both; a fit starts from one"
        )
    console.print(f"looking for {table.object} with a conventional detector")
    begin, name = time.perf_counter(), table.object
    with about("initial"):
        guess = table.build().find(
            problem.scene,
            name,
            sight.capture,
            sight.grid,
            loss=build.made(run, "loss"),
            seed=run.seed,
        )
        scene = _clouded(problem, guess.scene, name)
    found: dict[str, Any] = {"initial_points": guess.points} if guess.points else {}
    if guess.size is not None:
        known = table.scale and name in problem.known
        off = residual(guess.scene[name], problem.truth[name]) if known else None
        found |= {"initial_scale_error": abs(off.scale - 1)} if off else {}
        found |= {"initial_losses": guess.losses, "initial_size_m": list(guess.size)}
    found["initial_seconds"] = time.perf_counter() - begin
    return replace(problem, scene=scene), found


def _clouded(problem: Problem, scene: Scene, name: str) -> Scene:
    """The scene with a density from the backprojected echoes, where one is fitted."""
    sight = problem.first
    for table in problem.run.parameters:
        if table.kind == "density" and table.object == name:
            box = table.low, table.high, table.counts
            grid = guess_density(sight.capture, sight.grid, scene[name], name, *box)
            return scene.replace(name, cloud=grid.cloud)
    return scene
