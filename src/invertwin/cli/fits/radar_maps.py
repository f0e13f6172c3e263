"""Fits to maps of radars: power over range and direction."""

from collections.abc import Sequence
from typing import Any

import torch
from rich.console import Console
from torch import Tensor

from invertwin.cli.estimate import require_resources
from invertwin.cli.fits import problem as problems
from invertwin.cli.fits import radar_models, scores
from invertwin.cli.fits.fitting import calibrate_problem
from invertwin.cli.fits.problem import DataKind, Fits, Problem, Row, Start, Summary
from invertwin.cli.fits.shape_scores import is_shape_key
from invertwin.cli.fits.writing import START_COLUMNS, describe_outcome, draw_pictures, make_tables
from invertwin.cli.schema import RunFile, SimulatedData, build
from invertwin.forward_model import ForwardModel
from invertwin.inversion import Reconstruction, SpectrumLoss, Unknown
from invertwin.inversion.confidence.report import confidence_metrics, error_bar_coverage
from invertwin.models.radar import SurrogateMap
from invertwin.radar.parameters import ClockOffset, RangeBias
from invertwin.runtime.memory import peak_memory
from invertwin.scene import Scene
from invertwin.storage.run_folder import RunFolder

_RIGID = {"translation", "pose", "material", *problems.OF_SENSORS}


class RadarMaps(DataKind):
    """Spectra of radars, simulated or recorded."""

    def read_problem(self, run: RunFile, scene: Scene, truth: Scene, console: Console) -> Problem:
        """See ``DataKind.read_problem``."""
        sensors = radar_models.build_sensors(run)
        radar_models.warn_if_depths_differ(run, sensors)
        require_resources(run, truth, sensors)
        data = radar_models.record_sensors(run, sensors, truth, console)
        runs = problems.sensor_runs(run).values()
        simulated = all(isinstance(own.data, SimulatedData) for own in runs)
        known = frozenset(truth.names if simulated else run.truth)
        target = run.starts.object if run.starts else next(iter(run.fitted_objects), None)
        return Problem(run, scene, truth, known, data, target, kind=self)

    def prepare(self, problem: Problem, folder: RunFolder, console: Console) -> Problem:
        """The problem with its radar calibrated, and its object where echoes are."""
        calibrated = calibrate_problem(problem, folder, console)
        return radar_models.estimate_initial_scene(calibrated, console)

    def with_recording_of_start(self, problem: Problem, number: int, console: Console) -> Problem:
        """The problem with the recording of a start. Only the first one's is shared."""
        if number == 0 or not radar_models.has_recording_per_start(problem.run):
            return problem
        return radar_models.with_new_recording(problem, number, console)

    def models(self, problem: Problem) -> list[ForwardModel]:
        """See ``DataKind.models``."""
        return radar_models.make_radar_models(problem)

    def allows_clutter(self, problem: Problem) -> bool:
        """True with the likelihood of mean power, while objects keep their shapes."""
        loss = build.build_loss(problem.run)
        likely = isinstance(loss, SpectrumLoss) and loss.kind != "mse"
        models = all(isinstance(model, SurrogateMap) for model in self.models(problem))
        rigid = {p.kind for p in problem.run.parameters} <= _RIGID
        shared = not radar_models.has_recording_per_start(problem.run)
        return likely and models and rigid and shared and problem.run.search is None

    def sensor_unknowns(self, problem: Problem, name: str) -> dict[str, Any]:
        """Nuisances of a radar."""
        positions = problem.sensor_data[name].recording.positions
        begin = f"{name}." if name else ""
        return {
            begin + kind: Unknown(RangeBias() if kind == "range_bias" else ClockOffset(positions))
            for kind in problem.run.fit_settings.nuisances
        }

    def score_fit(self, problem: Problem, start: Start, found: Reconstruction) -> Row:
        """Distances to the truth; of a recording of its own, error bars, too."""
        rows = scores.score_fit(problem, start.scene, found.scene)
        own = radar_models.has_recording_per_start(problem.run)
        return rows | (confidence_metrics(found, problems.known_truth(problem)) if own else {})

    def measured_maps(self, problem: Problem) -> list[Tensor]:
        """Spectra of the recordings."""
        return [item.recording.spectrum(item.grid).float() for item in problem.sensor_data.values()]

    def predict_maps(self, problem: Problem, scene: Scene, sensors: Sequence[Any]) -> list[Tensor]:
        """Sharp spectra of a scene."""
        counts = {"samples": 4 * problem.run.fit_settings.samples, "boundary_samples": 0}
        models = [m.with_sampling(**counts) for m in radar_models.make_display_models(problem)]
        pairs = zip(models, sensors, strict=True)
        with torch.no_grad():
            return [model.predict(scene, radar, problem.run.seed) for model, radar in pairs]

    def metrics(self, fits: Fits) -> Row:
        """See ``DataKind.metrics``."""
        problem, rows, best, methods = fits.problem, fits.rows, fits.best, fits.methods
        found: Row = scores.summarise_successes(problem, rows, methods)
        if radar_models.has_recording_per_start(problem.run):
            found |= error_bar_coverage(rows[problems.OWN_METHOD])
        shown = [k for k in best if (k in START_COLUMNS or is_shape_key(k)) and k != "seconds"]
        measured = fits.maps["measured"]
        found |= {
            **{key: best[key] for key in shown},
            "start_loss_sharp": scores.total_loss(problem, fits.maps["start"], measured),
            "loss_sharp": scores.total_loss(problem, fits.maps["twin"], measured),
            **scores.surrogate_agreement(problem, fits.found.scene, fits.found.sensors[0]),
            **scores.score_held_out(problem, rows[problems.OWN_METHOD], best),
        }
        for method in methods[1:]:
            same = rows[method][min(best["start"], len(rows[method]) - 1)]
            own = [key for key in same if is_shape_key(key) and not key.startswith("true_")]
            found |= {f"{key}_{method}": same[key] for key in own}
        if (held := peak_memory()) is not None:
            found["peak_memory_gb"] = held / 1e9
        return found

    def summary(self, fits: Fits, metrics: Row, folder: RunFolder) -> Summary:
        """See ``DataKind.summary``."""
        result, *tables = make_tables(fits, metrics)
        outcome = describe_outcome(fits.problem.run, metrics)
        return Summary(outcome, result, draw_pictures(fits, metrics, folder), tables)
