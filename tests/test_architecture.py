"""The one-way arrows between the rooms, read from the source with ast."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "src" / "invertwin"

FOUNDATION = {
    "constants",
    "errors",
    "limits",
    "seeds",
    "checks",
    "refusals",
    "deprecation",
    "runtime",
    "storage",
}
SCENE = FOUNDATION | {"scene"}
CHANNEL = SCENE | {"channel"}
RADAR = CHANNEL | {"radar"}
LINKS = CHANNEL | {"links"}
CAMERA = CHANNEL | {"camera"}
CAPTURE = RADAR | {"capture"}
SIMULATION = CAPTURE | {"simulation"}
SIGNATURES = CHANNEL | {"signatures"}
DATASETS = RADAR | {"datasets"}
CONTRACT = SCENE | {"forward_model"}
MODELS = SIMULATION | LINKS | CAMERA | SIGNATURES | CONTRACT | {"models"}
# A fit knows the contract of models, and initial estimates know captures; no fit knows a model.
INVERSION = CAPTURE | CONTRACT | {"inversion"}
DISCOVERY = INVERSION | MODELS | {"discovery"}
PLOTTING = DISCOVERY | {"plotting"}
VIEWER = PLOTTING | {"viewer"}

# Which rooms each room may import: only those before it. `__init__` is the package's own menu.
ALLOWED = {
    "constants": set(),
    "errors": set(),
    "limits": set(),
    "seeds": set(),
    "checks": {"errors", "limits"},
    "refusals": {"constants", "errors"},
    "deprecation": set(),
    "runtime": {"errors", "runtime"},
    "storage": {"errors", "storage"},
    "scene": SCENE,
    "channel": CHANNEL,
    "radar": RADAR,
    "links": LINKS,
    "camera": CAMERA,
    "simulation": SIMULATION,
    "signatures": SIGNATURES,
    "capture": CAPTURE,
    "datasets": DATASETS,
    "forward_model": CONTRACT,
    "models": MODELS,
    "inversion": INVERSION,
    "discovery": DISCOVERY,
    "plotting": PLOTTING,
    "viewer": VIEWER,
    "registry": FOUNDATION | {"registry"},
    "cli": VIEWER | DATASETS | {"registry", "cli", "__init__"},
    "__main__": {"errors", "cli"},
    "__init__": {"deprecation", "runtime", "viewer"},
}
# Inside a room: which of its folders each folder may import. Files beside the folders are either
# what all of them share, or the room's own top and menu; file cycles are forbidden anyway.
INSIDE = {
    "capture": {"ti": set(), "readers": {"ti"}},
    "channel": {
        "em": set(),
        "rays": {"em"},
        "power": {"em", "rays"},
        "coherent": {"em", "rays", "power"},
        "beams": {"em", "rays"},
        "specular": {"em", "rays"},
        "coverage": {"em", "rays", "power", "coherent", "specular"},
        "rcs": {"em", "rays", "beams"},
    },
    "cli": {"schema": set(), "fits": {"schema"}, "commands": {"schema", "fits"}},
    "discovery": {"imaging": set(), "shapes": set()},
    "inversion": {"confidence": set(), "initialisation": {"confidence"}, "gradcheck": set()},
    "radar": {"signal": set(), "processing": {"signal"}, "surrogate": {"signal", "processing"}},
    "scene": {"material": set(), "shape_models": set(), "people": {"shape_models"}},
}
RAY_TRACER = {"mitsuba", "drjit"}
KNOW_THE_RAY_TRACER = {"channel"}
SHAPELESS_NAMES = {"utils", "util", "helpers", "misc", "core", "common", "base"}


def imports(file: Path, package: Path) -> Iterator[tuple[int, str]]:
    """Every import in a file, wherever it stands, as (line, absolute dotted name)."""
    parent = [package.name, *file.relative_to(package).parent.parts]
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            base = parent[: len(parent) - node.level + 1] if node.level else []
            module = ".".join([*base, *(node.module or "").split(".")]).strip(".")
            # `from package import x` may name a module: keep x, `module_of` drops it if not.
            for alias in node.names:
                yield node.lineno, f"{module}.{alias.name}"


def module_of(name: str, package: Path) -> Path | None:
    """The file of the package that a dotted name reaches, or None for other packages."""
    parts = name.split(".")
    if parts[0] != package.name:
        return None
    path = package
    for part in parts[1:]:
        if (path / part).is_dir():
            path = path / part
        else:
            file = path / f"{part}.py"
            return file if file.exists() else path / "__init__.py"
    return path / "__init__.py"


def room_of(file: Path, package: Path) -> str:
    first = file.relative_to(package).parts[0]
    return first.removesuffix(".py")


def imports_by_string(file: Path, package: Path) -> Iterator[int]:
    """Lines that import a module of the package by a string, which no import statement shows."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if not (isinstance(node, ast.Call) and node.args):
            continue
        if ast.unparse(node.func).rpartition(".")[2] not in ("import_module", "__import__"):
            continue
        first = node.args[0]
        if isinstance(first, ast.JoinedStr) and first.values:
            first = first.values[0]
        # A name that begins with a dot is one of the package's own, too.
        if isinstance(first, ast.Constant) and str(first.value).split(".")[0] in ("", package.name):
            yield node.lineno


def folder_of(file: Path, package: Path) -> str:
    """The folder inside its room in which a file lies; empty for files of the room itself."""
    parts = file.relative_to(package).parts
    return parts[1] if len(parts) > 2 else ""


def cycles(graph: dict[Path, set[Path]]) -> list[list[Path]]:
    found: list[list[Path]] = []
    finished: set[Path] = set()

    def visit(file: Path, trail: list[Path]) -> None:
        if file in trail:
            found.append([*trail[trail.index(file) :], file])
        elif file not in finished:
            for target in sorted(graph.get(file, ())):
                visit(target, [*trail, file])
            finished.add(file)

    for file in sorted(graph):
        visit(file, [])
    return found


def violations(package: Path) -> list[str]:
    """One line for each broken rule in the package below this folder."""
    problems = []
    graph: dict[Path, set[Path]] = {}
    for file in sorted(package.rglob("*.py")):
        where = file.relative_to(package)
        room = room_of(file, package)
        if file.stem in SHAPELESS_NAMES or where.parts[0] in SHAPELESS_NAMES:
            problems.append(f"{where}: a name that says nothing")
        if room not in ALLOWED:
            problems.append(f"{where}: '{room}' is no room of the house")
            continue
        graph[file] = set()
        problems += [
            f"{where}:{line}: an import by a string; write an import statement"
            for line in imports_by_string(file, package)
        ]
        for line, name in imports(file, package):
            if name.split(".")[0] in RAY_TRACER and room not in KNOW_THE_RAY_TRACER:
                problems.append(f"{where}:{line}: {name} belongs in channel/")
            if name.split(".")[0] == "invertwin_studies":
                problems.append(f"{where}:{line}: studies build on the package, not it on them")
            if name.startswith("matplotlib.pyplot"):
                problems.append(f"{where}:{line}: pyplot has global state; use Figure")
            target = module_of(name, package)
            if target is None:
                continue
            to = room_of(target, package)
            if to not in ALLOWED[room]:
                problems.append(f"{where}:{line}: {room} must not import {to}")
            here, there = folder_of(file, package), folder_of(target, package)
            inner = to == room and "" not in (here, there) and here != there
            if inner and there not in INSIDE.get(room, {}).get(here, set()):
                problems.append(f"{where}:{line}: {here} must not import {there} in {room}/")
            # The menu of the channel, and the plain values of what is to be sampled.
            values = {package / "channel" / name for name in ("__init__.py", "sampling.py")}
            inside = target not in values
            if to == "channel" and inside and room not in KNOW_THE_RAY_TRACER:
                problems.append(f"{where}:{line}: {name} is not in the menu of channel/")
            # A folder's __init__ is its menu: importing from it inside its room is no cycle of
            # its own, but it is one once the menu imports the importer.
            if target != file and room != "__init__":
                graph[file].add(target)
    for cycle in cycles(graph):
        problems.append("cycle: " + " → ".join(str(f.relative_to(package)) for f in cycle))
    return problems


def test_imports_follow_the_arrows():
    assert violations(PACKAGE) == []


def test_every_room_is_known():
    assert {room_of(f, PACKAGE) for f in PACKAGE.rglob("*.py")} <= set(ALLOWED)


@pytest.mark.parametrize(
    ("file", "source", "complaint"),
    [
        ("scene/mesh.py", "from invertwin.channel import paths", "scene must not import channel"),
        ("scene/mesh.py", "from ..radar.waveform import FMCW", "scene must not import radar"),
        ("channel/paths.py", "import invertwin.radar", "channel must not import radar"),
        ("channel/paths.py", "def f():\n    from invertwin import cli", "must not import cli"),
        ("simulation.py", "from invertwin.plotting import scene", "must not import plotting"),
        (
            "capture/readers/netcdf.py",
            "from invertwin.simulation import simulate",
            "must not import sim",
        ),
        ("radar/waveform.py", "import mitsuba as mi", "belongs in channel/"),
        ("radar/waveform.py", "def f():\n    from drjit.llvm import Float", "belongs in channel/"),
        ("radar/waveform.py", "from invertwin import Scene", "radar must not import __init__"),
        ("radar/waveform.py", "from invertwin.plotting import scene", "must not import plotting"),
        ("cli/app.py", "from matplotlib import pyplot", "pyplot has global state"),
        ("cli/app.py", "import invertwin_studies.peers", "not it on them"),
        ("scene/utils.py", "", "says nothing"),
        ("misc/thing.py", "", "says nothing"),
        ("garage/car.py", "", "no room of the house"),
        ("scene/mesh.py", "from invertwin.scene.scene import Scene", "cycle: "),
        ("channel/rays/tables.py", "import invertwin.channel.power.bins", "must not import power"),
        ("channel/em/utd.py", "from ..rays.scene import x", "em must not import rays in channel/"),
        ("radar/signal/nufft.py", "from ..processing import music", "must not import processing"),
        ("inversion/fit.py", "from invertwin.models.radar import M", "must not import models"),
        ("scene/mesh.py", 'importlib.import_module("invertwin.viewer")', "import by a string"),
        ("scene/mesh.py", 'import_module(f"invertwin.{name}")', "import by a string"),
        ("scene/mesh.py", '__import__(".viewer")', "import by a string"),
    ],
)
def test_a_planted_violation_is_caught(tmp_path, file, source, complaint):
    package = tmp_path / "invertwin"
    rooms = ("scene/scene.py", "channel/paths.py", "radar/waveform.py", "capture/readers/netcdf.py")
    rooms += ("channel/rays/scene.py", "channel/power/bins.py", "channel/em/utd.py")
    rooms += ("radar/signal/nufft.py", "radar/processing/music.py", "models/radar.py")
    for name in (*rooms, "inversion/fit.py", "plotting/scenes.py"):
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text("")
        (package / name).with_name("__init__.py").write_text("")
    (package / "__init__.py").write_text("")
    (package / "simulation.py").write_text("from invertwin.radar.waveform import FMCW\n")
    (package / "cli").mkdir()
    (package / "cli" / "__init__.py").write_text("")
    (package / "scene" / "scene.py").write_text("from invertwin.scene.mesh import Mesh\n")
    (package / "scene" / "mesh.py").write_text("")
    assert violations(package) == []
    (package / file).parent.mkdir(exist_ok=True)
    (package / file).write_text(source)
    assert any(complaint in problem for problem in violations(package)), violations(package)


def test_the_table_of_contributing_has_every_room_below_those_it_imports():
    text = (PACKAGE.parents[1] / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = [line for line in text.splitlines() if line.startswith("| `")]
    place = {
        name: n
        for n, row in enumerate(rows)
        for name in re.findall(r"`(\w+)(?:/|\.py)`", row.split("|")[1])
    }
    assert set(place) == set(ALLOWED) - {"__init__", "__main__"}
    for room, below in ALLOWED.items():
        for other in below - {"__init__"} if room in place else ():
            assert place[other] <= place[room], f"{room} stands above {other}"
    for room, folders in INSIDE.items():
        named = set(re.findall(r"`(\w+)/`", rows[place[room]]))
        assert set(folders) <= named, f"{room}/: {sorted(set(folders) - named)} are not in its row"
