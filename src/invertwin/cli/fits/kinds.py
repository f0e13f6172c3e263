"""The problem of a run file, by its kind of data."""

from rich.console import Console

from invertwin.cli.fits.moving_target import MovingTarget
from invertwin.cli.fits.panel_coverage import PanelCoverage
from invertwin.cli.fits.problem import DataKind, Problem
from invertwin.cli.fits.radar_maps import RadarMaps
from invertwin.cli.fits.received_levels import ReceivedLevels
from invertwin.cli.fits.transmitter_coverage import TransmitterCoverage
from invertwin.cli.run_file import prefix_errors, require_section
from invertwin.cli.schema import RunFile, build
from invertwin.cli.schema.shape_tables import MovingTargetParameter
from invertwin.refusals import refusal

# By the section that tells it, the first that is there.
_KINDS = {"placement": PanelCoverage, "aim": TransmitterCoverage, "map": ReceivedLevels}
_MADE_FROM_DATA = ("transmitter", "panel", "panel_phases", "mover")  # parameters that need them


def kind_of(run: RunFile) -> DataKind:
    """The kind of data that a run file fits."""
    for section, kind in _KINDS.items():
        if getattr(run, section) is not None:
            return kind()
    first = next(iter(run.parameters), None)
    return MovingTarget() if isinstance(first, MovingTargetParameter) else RadarMaps()


def build_problem(run: RunFile, console: Console) -> Problem:
    """The problem of a run file; simulated data are simulated here.

    Args:
        run: The run file.
        console: Shows progress.

    Raises:
        InputError: A section is missing or does not fit the data.
    """
    require_section(run, "parameters", "reconstruct")
    kind, scene, truth = kind_of(run), build.scene(run), build.true_scene(run)
    for i, parameter in enumerate(run.parameters):
        if parameter.kind == "mover" and not isinstance(kind, MovingTarget):
            raise refusal("kinds.other_parameters", i, len(run.parameters))
    # Their errors come before any work.
    _try_parameters(run, run)
    for name, variant in run.variants.items():
        with prefix_errors(f"variants.{name}"):
            _try_parameters(run.model_copy(update={"parameters": variant.parameters or []}), run)
    return kind.read_problem(run, scene, truth, console)


def _try_parameters(own: RunFile, run: RunFile) -> None:
    scene, makers = build.scene(run), build.module_builders(own.parameters, run.scene)
    for name, table in build.tables_by_name(own.parameters).items():
        if table.kind not in _MADE_FROM_DATA:
            makers[name](scene)
