"""Derivatives of signatures: beams whose edges move, and what they are at fixed visibility."""

import tomllib
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from invertwin.cli.run_file import validate_run
from invertwin.cli.schema import build
from invertwin.inversion.gradcheck.gradcheck import GradcheckSettings, GradientReport, gradcheck
from invertwin.models.rcs import RcsMap
from invertwin.scene import Object, PerfectConductor, Scale, Scene, dihedral
from invertwin.signatures import aspect_directions, rcs
from scenes import relative

FOLDER = Path(__file__).resolve().parents[2] / "experiments" / "gradients" / "coherent"
BEAMS = {
    **dict.fromkeys(("dihedral_aspect", "dihedral_opening", "dihedral_side"), 4),
    **dict.fromkeys(("trihedral_shift", "trihedral_tilt"), 2),
}  # with how many aspects


def check_run(name: str, count: int) -> GradientReport:
    """The gradient check of a run file, with fewer aspects."""
    file = FOLDER / f"{name}.toml"
    raw = tomllib.loads(file.read_text(encoding="utf-8"))
    swept = next(value for value in raw["rcs"].values() if isinstance(value, dict))
    swept["count"] = count
    run = validate_run(raw, file)
    assert run.gradcheck is not None
    assert run.rcs is not None
    table, scene = run.rcs, build.scene(run)
    module, tangent = build.tangent(run, scene)
    model = RcsMap(compute=lambda seen, **more: table.build({Scene: seen}, **more))
    return gradcheck(
        model, module, tangent, scene=scene, sensor=None, settings=run.gradcheck.build()
    )


def test_all_run_files_are_here():
    assert {file.stem for file in FOLDER.glob("*.toml")} == {*BEAMS, "plate_aspect"}


@pytest.mark.parametrize(("name", "count"), BEAMS.items())
def test_beams_whose_edges_move(name, count):
    report = check_run(name, count)
    assert report.full.relative_l1 < 1e-4
    assert report.interior.relative_l1 > 0.01
    assert report.difference_noise == 0
    assert report.pairs == 1
    assert report.no_interior_edges is None
    assert report.no_contact is None


def test_a_plate_through_broadside_has_no_beams_that_end_on_it():
    report = check_run("plate_aspect", 4)
    assert report.full.relative_l1 < 1e-4
    assert relative(report.interior_gradient, report.gradient) < 1e-9


def test_fixed_visibility_changes_no_value():
    corner = Scene({"corner": Object(dihedral(0.1, 1.5), PerfectConductor())})
    model = RcsMap(aspect_directions([2.9, 3.1, 3.4], 0.2), 30e9, edges=0)
    value = model.predict(corner, None, 0)
    fixed = replace(model, boundary=False)
    assert torch.allclose(fixed.predict(corner, None, 1), value, rtol=1e-9)
    assert torch.equal(model.observe(rcs(corner, model.directions, 30e9, edges=0)), value)
    (ablated,) = model.ablations().values()
    assert isinstance(ablated, RcsMap)
    assert (ablated.boundary, ablated.edges) == (False, 0)
    assert not fixed.ablations()


@pytest.mark.parametrize("boundary", [True, False])
def test_both_modes_agree(boundary):
    """Reverse mode through the clipped polygons, against the forward mode of the check."""
    corner = Scene({"corner": Object(dihedral(0.1, 1.5), PerfectConductor())})
    model = RcsMap(aspect_directions([2.9, 3.4], 0.2), 30e9, edges=0)
    module = Scale("corner")
    report = gradcheck(
        model,
        module,
        {"log_scale": 1.0},
        scene=corner,
        sensor=None,
        settings=GradcheckSettings(step=1e-5),
    )
    forward = report.gradient if boundary else report.interior_gradient
    total = replace(model, boundary=boundary).predict(module(corner), None, 0).sum()
    (backward,) = torch.autograd.grad(total, [*module.parameters()])
    assert float(backward.sum()) == pytest.approx(float(forward.sum()), rel=1e-9)
