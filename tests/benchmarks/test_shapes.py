"""The shapes benchmark: its cars, what it makes of their fits, and that it goes on where it was."""

import json
import math
from pathlib import Path

import pytest
import torch

from invertwin.cli.fits.problem import method_run
from invertwin.cli.run_file import require_section
from invertwin.cli.schema import build
from invertwin.scene import load_mesh
from invertwin_studies.vehicles import Car, car_mesh


def curve(*values):
    return [[10 * (k + 1), value] for k, value in enumerate(values)]


def car(pose, free, prior, falling):
    def row(chamfer, iou, shown=(), seconds=1.0):
        return {
            "chamfer_m": chamfer,
            "iou": iou,
            "chamfer_seen_m": chamfer,
            "iou_seen": iou,
            "start_chamfer_m": 0.16,
            "start_iou": 0.5,
            "steps": 30,
            "seconds": seconds,
            "curve": curve(*shown) or curve(chamfer, chamfer, chamfer),
        }

    return {
        "pose_only": row(pose, 0.7),
        "free": row(free, 0.8),
        "prior": row(prior, 0.9, falling, seconds=3.0),
    }


MAIN = ("prior", "free")
GOOD = car(0.10, 0.07, 0.04, (0.09, 0.06, 0.04))
BAD = car(0.10, 0.03, 0.09, (0.12, 0.11, 0.09))


def test_what_a_car_tells(shapes):
    row = shapes.compared(GOOD)
    assert row["chamfer_ratio"] == pytest.approx(0.4)
    assert row["iou_gain"] == pytest.approx(0.2)
    assert row["iteration_ratio"] == pytest.approx(20 / 30)
    assert row["seconds_ratio"] == pytest.approx(20 / 30 * 3)
    assert shapes.compared(BAD)["iteration_ratio"] == math.inf
    assert shapes.compared(BAD)["seconds_ratio"] == math.inf


def test_medians_and_the_worst_car(shapes):
    metrics = shapes.summary({1: GOOD, 2: BAD, 3: GOOD})
    assert metrics["chamfer_ratio"] == pytest.approx(0.4)
    assert metrics["worst"]["car"] == 2
    assert metrics["chamfer_m"] == {"pose_only": 0.10, "free": 0.07, "prior": 0.04}
    lines = shapes.verdicts(metrics)
    assert [line.endswith(": holds") for line in lines] == [True, True, False]


def test_cars_differ_in_shape_and_start_only(shapes):
    run = shapes.load_run(shapes.RUN)
    first, again, second = (shapes.run_of(k, run) for k in (1, 1, 2))
    assert first == again
    for own in (first, second):
        place = own.scene["car"].position
        assert math.hypot(*place) == pytest.approx(shapes.DISTANCE)
        assert place[2] == 0.0
        (part,) = own.truth["car"].parts
        assert len(part.coefficients) == shapes.MODES_OF_SPACE
        assert max(map(abs, part.coefficients)) <= shapes.CUT
    assert first.truth != second.truth
    assert first.scene != second.scene
    same = {"seed": run.seed, "scene": run.scene, "truth": run.truth}
    assert first.model_copy(update=same) == run


def test_the_start_is_as_far_from_the_truth_as_it_says(shapes):
    """The scenes that are built tell: a truth stands where the start does unless it says where."""
    own = shapes.run_of(3, shapes.load_run(shapes.RUN))
    truth = {"car": own.truth["car"].model_copy(update={"parts": None})}
    bare = own.model_copy(update={"truth": truth})
    start, true = (make(bare)["car"].transform for make in (build.scene, build.true_scene))
    away = (start - true)[:3, 3]
    assert float(away.norm()) == pytest.approx(shapes.DISTANCE)
    assert float(away[2]) == 0.0
    assert float(true[:3, 3].norm()) == 0.0


def test_the_start_is_turned_by_ten_degrees(shapes):
    run = shapes.load_run(shapes.RUN)
    turns = []
    for own in (shapes.run_of(k, run) for k in (1, 2, 3)):
        start, truth = (
            shapes.Rotation.from_rotvec(vector, degrees=True)
            for vector in (own.scene["car"].rotation_deg, own.truth["car"].rotation_deg)
        )
        turns.append((start * truth.inv()).as_rotvec(degrees=True))
    for turn in turns:
        assert abs(turn[2]) == pytest.approx(shapes.ANGLE_DEG)
        assert abs(turn[:2]).max() < 1e-9


def test_finished_cars_are_read_unless_the_run_file_has_changed(shapes, tmp_path, monkeypatch):
    run, fits = shapes.load_run(shapes.RUN), []

    def fitted(own):
        fits.append(own.seed)
        return GOOD

    monkeypatch.setattr(shapes, "fitted", fitted)
    shapes.measure(tmp_path, 2, run)
    found = shapes.measure(tmp_path, 3, run)
    assert fits == [1, 2, 3]
    assert found["count"] == 3
    assert (tmp_path / "shapes.png").stat().st_size > 0
    other = run.model_copy(update={"note": "another"})
    shapes.measure(tmp_path, 1, other)
    assert fits == [1, 2, 3, 1]


def test_cars_that_others_fit_are_those_that_are_missing(shapes, tmp_path, monkeypatch):
    run = shapes.load_run(shapes.RUN)
    monkeypatch.setattr(shapes, "fitted", lambda own: GOOD if own.seed < 3 else BAD)
    shapes.measure(tmp_path, 1, run)
    asked = []

    def spread(work, jobs, *, engine, workers):
        asked.append((engine, workers, len(jobs)))
        for at in reversed(range(len(jobs))):  # others end in any order
            yield at, work(jobs[at])

    monkeypatch.setattr(shapes, "run_jobs", spread)
    found = shapes.measure(tmp_path, 3, run, shapes.FitWorkers("ray", 1))
    assert asked == [("ray", 1, 2)]
    assert list(found["cars"]) == ["1", "2", "3"]
    assert found["worst"]["car"] == 3
    assert shapes.measure(tmp_path, 3, run)["cars"] == found["cars"]


def test_infinite_numbers_are_null_in_the_file(shapes, tmp_path, monkeypatch):
    monkeypatch.setattr(shapes, "fitted", lambda own: BAD)
    metrics = shapes.measure(tmp_path, 1)
    assert metrics["iteration_ratio"] == math.inf
    assert json.loads((tmp_path / "metrics.json").read_text())["iteration_ratio"] is None


def test_every_method_is_a_fit_of_the_run_file(shapes):
    run = shapes.load_run(shapes.RUN)
    assert set(shapes.MODES.values()) == {shapes.OWN_METHOD, *run.variants}
    for mode in shapes.MODES.values():
        settings = require_section(method_run(run, mode), "reconstruct", "reconstruct")
        assert settings.steps % require_section(run, "measures", "reconstruct").every == 0


def test_both_run_files_are_one_experiment(shapes):
    """What one has as its main fit is a variant of the other."""
    one, other = (shapes.load_run(shapes.RUN.with_name(f"shape_car_{n}.toml")) for n in MAIN)
    same = {name: getattr(one, name) for name in ("title", "reconstruct", "optimizer", "variants")}
    assert other.model_copy(update=same) == one
    for mine, theirs in (
        (shapes.OWN_METHOD, "prior"),
        ("free", shapes.OWN_METHOD),
        ("pose_only",) * 2,
    ):
        fits = method_run(one, mine), method_run(other, theirs)
        first, second = (
            found.model_copy(
                update={
                    "variants": {},
                    "title": "",
                }
            )
            for found in fits
        )
        assert first == second


def test_the_public_run_file_is_the_experiment_with_another_car(shapes):
    public = shapes.load_run(shapes.RUN)
    own = shapes.load_run(shapes.RUN.with_name("shape_car_prior.toml"))
    other = {name: getattr(own, name) for name in ("title", "note", "truth")}
    assert public.model_copy(update=other) == own
    (theirs,), (mine,) = public.truth["car"].parts, own.truth["car"].parts
    assert (theirs.shape, Path(mine.file).name) == ("vehicle", "car.ply")


def test_the_car_of_the_project_is_made_by_its_generator(shapes):
    """The mesh in the repository can be made anew."""
    car = Car(
        length=4.38,
        width=1.79,
        height=1.51,
        clearance=0.17,
        wheelbase=2.62,
        front_overhang=0.86,
        wheel_radius=0.315,
        nose_height=0.76,
        bumper_height=0.47,
        cowl_height=1.0,
        cowl_setback=0.42,
        screen_angle=30.0,
        roof_peak=0.35,
        roof_rear_drop=0.11,
        deck_height=1.01,
        deck_length=0.06,
        rear_angle=57.0,
        tail_lean=0.09,
        belt_height=0.96,
        belt_rise=0.08,
        shoulder_height=0.71,
        tumblehome=17.0,
        rounding=0.07,
    )
    made, kept = car_mesh(car, spacing=0.1), load_mesh(shapes.RUN.with_name("car.ply"))
    assert torch.equal(made.faces, kept.faces)
    assert float((made.vertices - kept.vertices).abs().max()) < 1e-6


@pytest.mark.slow
def test_a_car_is_fitted(shapes, data_folder, monkeypatch):
    monkeypatch.setenv("INVERTWIN_DATA", str(data_folder))
    run = shapes.run_of(1, shapes.load_run(shapes.RUN))
    cheap = {"steps": 3, "samples": 20_000, "boundary_samples": 4_000, "frames_per_step": 6}
    short = run.reconstruct.model_copy(update=cheap)
    few = run.data.model_copy(update={"points_per_m2": 50.0})
    every = run.measures.model_copy(update={"every": 1})
    monkeypatch.setattr(shapes, "MODES", {"prior": shapes.OWN_METHOD})
    run = run.model_copy(update={"reconstruct": short, "data": few, "measures": every})
    (found,) = shapes.fitted(run).values()
    assert [step for step, _ in found["curve"]] == [1, 2, 3]
    assert found["curve"][-1][1] == pytest.approx(found["chamfer_m"], rel=1e-6)
    assert 0.05 < found["start_chamfer_m"] < 0.3
    assert 0.4 < found["start_iou"] < 0.8
