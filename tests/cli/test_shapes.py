"""Shapes in run files: stages, variants, measures and what they leave behind."""

import tomllib

import pytest
from PIL import Image
from rich.console import Console
from torch import nn

from cli.small import RUN, call, read_metrics
from invertwin.cli.fits.kinds import build_problem
from invertwin.cli.fits.problem import (
    OWN_METHOD,
    Fits,
    Problem,
    Start,
    make_schedule,
    method_run,
    stage_runs,
)
from invertwin.cli.fits.radar_maps import RadarMaps
from invertwin.cli.fits.radar_models import blur_end_step
from invertwin.cli.fits.shape_scores import is_shape_key, score_shape, shape_label
from invertwin.cli.fits.writing import make_tables
from invertwin.cli.run_file import to_toml, validate_run
from invertwin.cli.schema import build
from invertwin.cli.schema.shape_tables import shape_regularizers
from invertwin.errors import InputError
from invertwin.inversion import Reconstruction
from invertwin.inversion.confidence.realisations import FitResult
from invertwin.scene import Mesh, PriorShape
from invertwin.scene.files import load_mesh

HEAD, TAIL = RUN.split("[[parameters]]")
SHAPES = """
[[truth.plate.parts]]
shape = "plate"
width = 0.3
height = 0.3
divisions = 2

[[parameters]]
kind = "vertices"
object = "plate"
smooth = 5.0
rate = 0.004

[[parameters]]
name = "field"
kind = "distance_grid"
object = "plate"
low = [-0.1, -0.3, -0.3]
high = [0.1, 0.3, 0.3]
counts = [5, 7, 7]

[reconstruct]
steps = 3
depth = 1
samples = 6000
boundary_samples = 2000

[[stages]]
parameters = ["vertices"]

[[stages]]
parameters = ["vertices"]
remesh = 0.06
reconstruct = { steps = 2 }
optimizer = { rate = 0.01 }

[variants.no_boundary]
reconstruct = { boundary = false }

[variants.rough]
stages = [{ parameters = ["vertices"], reconstruct = { steps = 2 } }]

[[variants.rough.parameters]]
kind = "vertices"
object = "plate"
rate = 0.004

[measures]
object = "plate"
seen = true
every = 1
"""


def shapes(text: str = SHAPES) -> str:
    return HEAD + text


def check(text: str, tmp_path):
    return validate_run(tomllib.loads(text), tmp_path / "run.toml")


@pytest.mark.slow
def test_a_shape_is_fitted_in_stages_and_compared(tmp_path, monkeypatch, capsys):
    (tmp_path / "shape.toml").write_text(shapes())
    out = tmp_path / "out"
    assert call(monkeypatch, "reconstruct", tmp_path / "shape.toml", "-o", out) == 0
    metrics = read_metrics(out)
    assert metrics["steps"] == 5
    assert metrics["chamfer_m"] == metrics["chamfer_seen_m"]
    for key in ("chamfer_m", "fscore_2cm", "normal_consistency"):
        assert metrics[f"start_{key}"] > 0
        assert metrics[f"{key}_no_boundary"] > 0
        assert metrics[f"{key}_rough"] != metrics[key]
    assert len(load_mesh(out / "twin.ply").faces) > 18 + 2  # finer than at the start, and the wall
    assert len(load_mesh(out / "twin.glb").faces) == len(load_mesh(out / "twin.ply").faces)
    with Image.open(out / "turntable.gif") as picture:
        assert picture.n_frames == 24
    assert (out / "convergence.png").exists()
    assert not (out / "parts").exists()
    said = " ".join(capsys.readouterr().out.split())
    assert "Ways to fit" in said
    assert "Chamfer distance from" in said
    again = validate_run(tomllib.loads((out / "run.toml").read_text()), tmp_path / "run.toml")
    assert again == check(shapes(), tmp_path)


LETTERS = """
[[truth.plate.parts]]
shape = "text"
text = "AB"
size = 0.2
depth = 0.1

[[parameters]]
kind = "distance_grid"
object = "plate"
low = [-0.3, -0.3, -0.3]
high = [0.3, 0.3, 0.3]
counts = [7, 7, 7]

[reconstruct]
steps = 1
depth = 1
samples = 6000
boundary_samples = 2000

[measures]
object = "plate"
"""


def letters() -> str:
    flat = 'shape = "plate"\nwidth = 0.4\nheight = 0.3\ndivisions = 3'
    assert flat in HEAD
    return HEAD.replace(flat, 'shape = "sphere"\nradius = 0.2') + LETTERS


@pytest.mark.slow
def test_parts_and_holes_are_told_where_the_surface_is_closed(tmp_path, monkeypatch, capsys):
    (tmp_path / "run.toml").write_text(letters())
    out = tmp_path / "out"
    assert call(monkeypatch, "reconstruct", tmp_path / "run.toml", "-o", out) == 0
    metrics = read_metrics(out)
    found = [
        [metrics[f"{whose}{key}"] for key in ("components", "euler_number")]
        for whose in ("", "start_", "true_")
    ]
    assert found == [[1, 2], [1, 2], [2, -2]]
    said = " ".join(capsys.readouterr().out.split())
    assert "separate parts, truth" in said
    assert "Euler number, 2 less for every hole through a part, start" in said


@pytest.mark.parametrize(("voxel", "said"), [(1e-5, "at most 200,000,000 voxels"), (9.0, "none")])
def test_voxels_of_a_wrong_size_are_refused_before_the_fit(
    voxel, said, tmp_path, monkeypatch, capsys
):
    (tmp_path / "run.toml").write_text(f"{letters()}voxel = {voxel}\n")
    assert call(monkeypatch, "reconstruct", tmp_path / "run.toml", "-o", tmp_path / "out") == 2
    shown = capsys.readouterr()
    assert "measures: expected" in shown.err
    assert said in shown.err
    assert shown.err.count("\n") == 1
    assert "step 1" not in shown.out


def fits_that_end(problem, rows, twin):
    """Fits whose best one has ended at a twin."""
    result = FitResult.__new__(FitResult)  # no table asks for it
    found = Reconstruction(twin, [], nn.ModuleList(), [], "budget", 1, 0.0, result)
    start = Start(problem.scene)
    return Fits(problem, {OWN_METHOD: rows}, lambda *_: found, rows[0], start, found)


def test_a_twin_that_has_collapsed_has_no_measures(tmp_path):
    problem = build_problem(check(letters(), tmp_path), Console(quiet=True))
    start = problem.scene
    mesh = start["plate"].mesh
    twin = start.replace("plate", mesh=Mesh(0 * mesh.vertices, mesh.faces))
    found = score_shape(problem, start, twin)
    assert found["start_chamfer_m"] > 0
    assert not {"chamfer_m", "chamfer_seen_m", "iou"} & set(found)
    metrics = {"steps": 1, "status": "budget", "verdict": "worse", "parameters": {}, **found}
    result = make_tables(fits_that_end(problem, [found], twin), metrics)[0]
    assert ["Chamfer distance, mean of both directions [m]", None] in result.rows


def test_a_start_that_is_lost_says_so_in_the_table(tmp_path):
    problem = build_problem(check(letters(), tmp_path), Console(quiet=True))
    rows = [
        {"start": k, "loss": loss, "status": "converged", "lost": lost, "steps": 9, "seconds": 1.0}
        for k, (loss, lost) in enumerate([(0.7, False), (1.0, True)])
    ]
    metrics = {"steps": 9, "status": "converged", "verdict": "unknown", "parameters": {}}
    starts = make_tables(fits_that_end(problem, rows, problem.scene), metrics)[2]
    ended = starts.columns.index("status")
    assert [row[ended] for row in starts.rows] == [
        "the loss no longer falls",
        "lost: predicts none of the data",
    ]


def test_labels_tell_whose_a_measure_is():
    assert is_shape_key("true_components")
    assert shape_label("components") == "separate parts"
    assert shape_label("start_iou") == "intersection over union of volumes, start"
    assert not is_shape_key("start_loss_sharp")


def test_the_true_shape_stands_where_the_object_stands(tmp_path):
    run = check(shapes(), tmp_path)
    truth = build.true_scene(run)["plate"]
    assert truth.center.tolist() == pytest.approx([1.2, 0.02, 0.01])
    assert float(truth.vertices[:, 1].max() - truth.vertices[:, 1].min()) == pytest.approx(0.3)


def test_a_run_with_stages_survives_the_way_to_toml(tmp_path):
    run = check(shapes(), tmp_path)
    assert check(to_toml(run), tmp_path) == run


def test_extra_widths_end_where_the_only_stage_says(tmp_path):
    settings = "reconstruct = { steps = 2, annealing = 0.5 }\nsurrogate = { range_width = 3.0 }\n"
    one = LETTERS.replace("[measures]", f"[[stages]]\n{settings}\n[measures]")
    assert blur_end_step(check(shapes(LETTERS), tmp_path)) is None
    assert blur_end_step(check(shapes(one), tmp_path)) == 1.0
    wide = f"{shapes(LETTERS)}\n[surrogate]\nrange_width = 2.0\n"
    assert blur_end_step(check(wide, tmp_path)) == pytest.approx(0.7)
    assert blur_end_step(check(wide + "exact = true\n", tmp_path)) is None


def test_variants_and_stages_have_an_optimizer_of_their_own(tmp_path):
    text = shapes(SHAPES).replace(
        "[variants.no_boundary]\nreconstruct = { boundary = false }\n",
        '[variants.no_boundary]\noptimizer = { kind = "sgd", rate = 0.5 }\n'
        "reconstruct = { annealing = 0.25 }\nstages = []\n",
    )
    text = text.replace(
        "reconstruct = { steps = 2 }\noptimizer = { rate = 0.01 }\n",
        'reconstruct = { steps = 2, annealing = 0.5 }\noptimizer = { kind = "sgd" }\n',
    )
    run = check(text, tmp_path)
    own = method_run(run, "no_boundary")
    assert (own.optimizer.kind, own.optimizer.rate) == ("sgd", 0.5)
    assert own.reconstruct is not None
    assert own.reconstruct.annealing == 0.25
    assert method_run(run, OWN_METHOD).optimizer.kind == "adam"
    scene = build.scene(run)
    first, second = make_schedule(Problem(run, scene, scene, frozenset(), {}, None, RadarMaps()))
    assert first.optimizer == build.build_section(run, "optimizer")
    assert (first.steps, first.annealing) == (3, 0.7)
    assert second.optimizer is not None
    assert second.optimizer.kind == "sgd"
    assert second.annealing == 0.5


def learned(shape: str) -> str:
    text = shapes(SHAPES).replace(
        'shape = "plate"\nwidth = 0.4\nheight = 0.3\ndivisions = 3', shape
    )
    text = text.replace('kind = "vertices"', 'name = "vertices"\nkind = "prior"\nweight = 0.1')
    return text.replace("smooth = 5.0\n", "").replace("remesh = 0.06\n", "")


def test_learned_shapes_are_objects_and_parameters(tmp_path):
    run = check(learned('shape = "prior"'), tmp_path)
    scene = build.scene(run)
    assert len(scene["plate"].mesh.faces) > 200
    tables = build.tables_by_name(run.parameters)
    module = build.module_builders(run.parameters)["vertices"](scene)
    assert len(shape_regularizers(tables["vertices"], module, scene)) == 1


def test_learned_shapes_start_as_their_object(tmp_path):
    latent = [0.5, -0.25] + [0.0] * 22
    run = check(learned(f'shape = "prior"\nlatent = {latent}'), tmp_path)
    scene = build.scene(run)
    first, *_ = build.parameters(run.parameters, scene, objects=run.scene)
    assert isinstance(first, PriorShape)
    assert first.latent.tolist() == latent


def test_learned_shapes_have_a_size_of_their_own(tmp_path):
    with pytest.raises(InputError, match=r"scene.plate.scale: expected 1 .*, got 2; remove it"):
        check(learned('shape = "prior"\nscale = 2.0'), tmp_path)
    initial = '[initial]\nobject = "plate"\npose = "known"\nscale = true\n'
    with pytest.raises(InputError, match=r"initial.scale: expected false .*; remove it"):
        check(learned('shape = "prior"') + initial, tmp_path)


@pytest.mark.parametrize(
    "name",
    ["full", "whole", "seen", "count", "m", '"a/b"', "a-b", "2nd", '"a\\n"'],
)
def test_variants_have_names_of_their_own(name, tmp_path):
    text = shapes().replace("[variants.rough]", f"[variants.{name}]")
    with pytest.raises(InputError, match=r"variants: expected names of letters.*; choose another$"):
        check(text, tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('parameters = ["vertices"]\nremesh', 'parameters = ["vertex"]\nremesh', 'got "vertex"'),
        ('name = "field"', 'name = "vertices"', 'different names, got "vertices" twice'),
        ("remesh = 0.06", "remesh = -1.0", r"stages\[1\].remesh"),
        (
            'parameters = ["vertices"]\nremesh',
            'parameters = ["field"]\nremesh',
            r'stages\[1\].remesh: expected a parameter with kind = "vertices"',
        ),
        (
            "reconstruct = { boundary = false }",
            'reconstruct = { parameters = ["field"] }\nstages = [{ remesh = 0.1 }]',
            r"variants.no_boundary.stages\[0\].remesh: .*got none",
        ),
        ('object = "plate"\nseen', 'object = "plane"\nseen', "measures.object"),
        ("[variants.rough]\n", "[variants.rough]\nlaplacian = 1.0\n", "variants.rough.laplacian"),
        ("steps = 3\n", "also_interior_only = true\n", r"; add \[variants.interior_only\] with"),
    ],
)
def test_wrong_keys_are_named(old, new, message, tmp_path):
    text = shapes()
    assert old in text
    with pytest.raises(InputError, match=message):
        check(text.replace(old, new, 1), tmp_path)


@pytest.mark.parametrize(
    ("variant", "message"),
    [
        ("rate = 0.5", r"mine.rate: expected one of the keys .*; write it in `optimizer`"),
        ("reconstruct = { stepz = 5 }", r"variants.mine.reconstruct.stepz: .*mean `steps`"),
        ("optimizer = { rate = -1.0 }", r"variants.mine.optimizer.rate: expected .*, got -1.0"),
        ('optimizer = { kind = "adm" }', r"variants.mine.optimizer.kind: .*mean `adam`"),
        ("surrogate = { range_widht = 1.0 }", r"variants.mine.surrogate.range_widht: .*mean"),
        ('surrogate = "anealed"', r"variants.mine.surrogate: .*annealed"),
        (
            "stages = [{ optimizer = { rate = 0.0 } }]",
            r"variants.mine.stages\[0\].optimizer.rate: expected .*, got 0.0",
        ),
        (
            "stages = [{ reconstruct = { position_limit = 1.0 } }]",
            r"variants.mine.stages\[0\].reconstruct.position_limit: expected one of the keys",
        ),
        ('reconstruct = { observations = ["door"] }', r"variants.mine.reconstruct.observations"),
        (
            'parameters = [{ kind = "vertices", object = "plat" }]',
            r"variants.mine.parameters\[0\].object: .*mean `plate`",
        ),
    ],
)
def test_errors_of_a_variant_begin_at_its_own_path(variant, message, tmp_path):
    text = f"{shapes()}\n[variants.mine]\n{variant}\n"
    with pytest.raises(InputError, match=message) as caught:
        check(text, tmp_path)
    assert str(caught.value).count("also") == 0


def test_parts_are_merged_key_by_key_and_kinds_replace(tmp_path):
    text = shapes().replace(
        "[variants.no_boundary]\nreconstruct = { boundary = false }\n",
        '[variants.no_boundary]\noptimizer = { kind = "gauss_newton" }\nloss = { levels = 1 }\n'
        'surrogate = "response"\n',
    )
    text += '\n[loss]\nkind = "likelihood"\nfloor = 0.5\n[surrogate]\nangle_kernel = "airy"\n'
    run = check(text + "[optimizer]\nrate = 0.2\n", tmp_path)
    own = method_run(run, "no_boundary")
    assert own.loss is not None
    assert (own.loss.kind, own.loss.floor, own.loss.levels) == ("likelihood", 0.5, 1)
    assert (own.optimizer.kind, own.optimizer.rate) == ("gauss_newton", 0.03)
    assert (own.surrogate.range_kernel, own.surrogate.angle_kernel) == ("response", "response")
    first, second = (found.optimizer.rate for _, found in stage_runs(run))
    assert (first, second) == (0.2, 0.01)
