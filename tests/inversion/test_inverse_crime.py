"""No fit is shown data that its own model made: signals are exact, or recorded."""

import ast
import re
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from invertwin.capture import Capture
from invertwin.channel import Sampling
from invertwin.cli.fits.problem import stage_runs
from invertwin.cli.run_file import load_run
from invertwin.cli.schema import SimulatedData, build
from invertwin.cli.schema.radio_tables import ReceivedData
from invertwin.errors import InputError
from invertwin.models.radar import SurrogateMap
from scenes import occluder, radar

FEW = Sampling(depth=1, samples=1_000)
ROOT = Path(__file__).resolve().parents[2]
RUNS = sorted(
    file
    for file in (ROOT / "experiments").rglob("*.toml")
    if file.stem not in ("pyproject", "chirps")  # the latter describes a recording
)
PUBLIC = [
    file
    for file in RUNS
    if {"[data]", 'shape = "vehicle"'} <= set(file.read_text(encoding="utf-8").splitlines())
]
SCRIPTS = sorted([*(ROOT / "examples").glob("*.py"), *(ROOT / "benchmarks").glob("*.py")])


def sources() -> dict[str, str]:
    found = {str(file.relative_to(ROOT)): file.read_text(encoding="utf-8") for file in SCRIPTS}
    for page in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        blocks = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.S)
        found |= {f"{page.name} block {i}": block for i, block in enumerate(blocks)}
    return {name: text for name, text in found.items() if "reconstruct(" in text}


SOURCES = sources()


def test_there_is_something_to_guard():
    assert RUNS
    assert SOURCES


def test_a_surrogate_has_no_signal_to_fit():
    """A capture is made of signals, and the smooth model makes a map."""
    device = radar()
    grid = device.grid(0.5, 2.5)
    found = SurrogateMap(grid, sampling=FEW).predict(occluder(), device, 0)
    assert not found.is_complex()
    assert found.shape == (1, *grid.shape)
    assert {name for name in dir(Capture) if name.startswith("from_")} == {
        "from_beat",
        "from_range_profile",
    }


def name_of(file: Path) -> str:
    return str(file.relative_to(ROOT / "experiments"))


@pytest.mark.parametrize("file", [file for file in RUNS if file not in PUBLIC], ids=name_of)
def test_run_files_fit_exact_or_recorded_signals(file, monkeypatch):
    check_data(file, monkeypatch)


@pytest.mark.parametrize("file", PUBLIC, ids=name_of)
@pytest.mark.usefixtures("data_folder")
def test_run_files_of_public_shapes_fit_exact_signals(file, monkeypatch):
    check_data(file, monkeypatch)


def check_data(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever a run file simulates as data is traced as fields, point by point."""
    run = load_run(file)
    if run.data is None:
        # A placement has an aim, no data.
        assert run.task not in ("reconstruct", "demo") or run.placement or run.aim
        return
    if isinstance(run.data, ReceivedData):
        check_levels(run)
        return
    if not isinstance(run.data, SimulatedData):
        assert run.data.kind in ("capture", "rail_sar", "openradar", "dca1000", "arrays")
        return
    from invertwin.cli import exact_signals

    class FieldsTracedError(Exception):
        """Stops before the work is done."""

    def traced(*args, **options):
        raise FieldsTracedError

    monkeypatch.setattr("invertwin.channel.trace_field_with_mirrors", traced)
    for part in list(run.observations.values()) or [run]:
        table, bins = part.radar or run.radar, part.grid or run.grid
        assert table is not None
        assert bins is not None
        device = build.radar(table)
        scene = build.true_scene(run)
        if run.chirps is None:
            simulated = partial(
                exact_signals.simulate_exact, run, scene, device, build.grid(bins, device)
            )
        else:
            chirps = run.chirps.build()
            simulated = partial(exact_signals.simulate_chirp_beats, run, scene, device, chirps)
        with pytest.raises(FieldsTracedError):
            simulated()


def check_levels(run: Any) -> None:
    """Simulated levels know paths that no stage of any fit knows, and other rays."""
    ways = [run, *(run.apply_overrides(variant) for variant in run.variants.values())]
    fitted: list[Any] = [own.map for way in ways for _, own in stage_runs(way)]
    assert run.data.depth > max(table.depth for table in fitted)
    assert (run.data.edges or 0) > max(table.edges for table in fitted) or not run.data.edges
    assert run.data.rays > max(table.rays for table in fitted)
    assert run.data.seed not in (None, run.seed)


@pytest.mark.parametrize("name", SOURCES)
def test_scripts_fit_exact_or_recorded_signals(name):
    """What goes into a capture was not simulated with a surrogate."""
    tree = ast.parse(SOURCES[name])
    smooth = {
        target.id
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign)
        and isinstance(node.value, ast.Call)
        and ast.unparse(node.value.func).endswith("predict")
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    captured = [
        ast.unparse(node)
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and re.search(
            r"(Capture\.(from_beat|from_range_profile|load)|read|photograph|draw_world"
            r"|richer\.link_statistics)$",
            ast.unparse(node.func),
        )
    ]
    # The capture of a simulation is that of its exact signals; run files are guarded above.
    exact = ".capture" in SOURCES[name]
    # A placement has an aim, no data.
    aimed = re.search(r"reconstruct\(.*\bloss=", SOURCES[name])
    has_data = captured or exact or aimed or "build_problem(" in SOURCES[name]
    assert has_data, "a fit needs a capture"
    assert not [call for call in captured if any(re.search(rf"\b{n}\b", call) for n in smooth)]


def test_a_photograph_is_not_made_by_the_models_of_images():
    """Labels and depths meet the middles of pixels; what is fitted are means over areas."""
    source = (ROOT / "src/invertwin/camera/photographs.py").read_text(encoding="utf-8")
    assert not re.search(r"^(from|import) .*\.images\b", source, re.M)


def test_the_guard_sees_a_crime(unchecked):
    device = radar()
    smooth = SurrogateMap(device.grid(0.5, 2.5), sampling=FEW).predict(occluder(), device, 0)
    with pytest.raises(InputError, match="beat samples"):
        Capture.from_beat(smooth, device)
