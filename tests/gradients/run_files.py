"""Gradient checks of run files, with sampling and a map of the test's own."""

from dataclasses import replace
from pathlib import Path

from invertwin.channel import Sampling
from invertwin.cli.run_file import load_run
from invertwin.cli.schema import build
from invertwin.inversion.gradcheck.gradcheck import GradcheckSettings, GradientReport, gradcheck
from invertwin.models.radar import SurrogateMap
from invertwin.radar import Surrogate


def check_run(
    file: Path,
    *,
    samples: int,
    boundary_samples: int,
    check: GradcheckSettings,
    surrogate: Surrogate | None = None,
    oversample: int | None = None,
) -> GradientReport:
    """The gradient check of a run file.

    Args:
        file: The run file.
        samples: Of one derivative.
        boundary_samples: Of one derivative.
        check: How sharp it is; its step and scheme are those of the run file.
        surrogate: In place of the run file's.
        oversample: Of the grid, in place of the run file's.
    """
    run = load_run(file)
    assert run.radar is not None
    assert run.grid is not None
    assert run.gradcheck is not None
    radar, settings, scene = build.radar(run.radar), run.gradcheck, build.scene(run)
    grid = build.grid(run.grid, radar)
    if oversample is not None:
        bins = run.grid
        grid = radar.grid(bins.range_min, bins.range_max, bins.u_max, oversample=oversample)
    drawn = Sampling(depth=settings.depth, samples=samples, boundary_samples=boundary_samples)
    told = settings.build()
    module, tangent = build.tangent(run, scene)
    return gradcheck(
        SurrogateMap(grid, surrogate or build.build_section(run, "surrogate"), drawn),
        module,
        tangent,
        scene=scene,
        sensor=radar,
        acts_on=settings.acts_on,
        settings=replace(check, step=told.step, scheme=told.scheme),
        seed=1,
    )
