"""Nothing in the docs is unexecuted: snippets run, examples run, names and links exist."""

import ast
import html
import importlib
import inspect
import json
import os
import pickle
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from invertwin.cli.run_file import load_run, validate_run
from invertwin.cli.schema import RunFile
from invertwin.registry.kinds import PLUGINS
from invertwin_studies.recordings import rail_sar
from pages import start_page_runner
from public_names import ROOMS, cells, documented, menu, shown

pytestmark = pytest.mark.docs

REPOSITORY = Path(__file__).resolve().parents[1]
PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").glob("*.md"))]
WITH_PYTHON = [page for page in PAGES[1:] if "```python" in page.read_text()]
NEEDS_DATA = ["measured_data.md"]
REFERENCE = sorted((REPOSITORY / "docs" / "api").glob("*.md"))
TUTORIALS = sorted((REPOSITORY / "docs" / "tutorials").glob("*.py"))
EXAMPLES = sorted((REPOSITORY / "examples").glob("*.py"))

NAME = re.compile(r"`(invertwin(?:_studies)?(?:\.\w+)+)`")
LINK = re.compile(r"\]\(([^)#]+)(?:#[^)]*)?\)")
RUN_FILE = re.compile(r"\b(?:experiments|examples|benchmarks|tests)/[\w/*.]*\w")
CHECK_EXAMPLES = """
from pathlib import Path
from public_names import failures
if failures(Path({page!r})):
    raise AssertionError("examples of the page do not give what it says")
"""
WRITES = {
    "01_simulate.py": ["simulate.png"],
    "02_reconstruct.py": ["twin.ply"],
    "03_gradient.py": ["gradient.png"],
    "04_own_mesh_and_board.py": ["ball.ply", "ball.nc", "ball.png"],
    "06_coverage.py": ["coverage.png"],
}


@pytest.fixture(scope="session")
def page_runner():
    """One process for all pages; README and examples start as a user starts them, in their own."""
    with start_page_runner() as runner:
        yield runner


def run(arguments, folder):
    """What a user would see; a warning is an error, but for one of torch about itself."""
    ended = subprocess.run(
        [
            sys.executable,
            *("-W", "error"),
            *("-W", "ignore:`torch.jit.script` is deprecated:DeprecationWarning"),
            *arguments,
        ],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": ""},
        capture_output=True,
        text=True,
    )
    assert ended.returncode == 0, (ended.stdout + ended.stderr)[-3000:]
    return ended.stdout


@pytest.fixture(scope="module")
def readme(tmp_path_factory):
    """Run the README's snippet and return what it prints."""
    folder = tmp_path_factory.mktemp("readme")
    return run(["-c", "\n".join(cells(REPOSITORY / "README.md"))], folder)


@pytest.mark.slow
def test_readme_simulates_and_finds_the_letter(readme):
    start, found = (float(cm) for cm in re.findall(r"([\d.]+) cm off", readme))
    assert start > 30
    assert found < 3


def test_the_readme_is_short():
    (snippet,) = cells(REPOSITORY / "README.md")
    assert sum(bool(line.strip()) for line in snippet.splitlines()) <= 26
    assert len((REPOSITORY / "README.md").read_text("utf-8").split()) <= 1000


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [p for p in WITH_PYTHON if p.name not in NEEDS_DATA], ids=lambda page: page.name
)
def test_snippets_of_a_page_run(page, page_runner, tmp_path):
    page_runner.run("\n".join(cells(page)), tmp_path)
    assert not list(tmp_path.iterdir()), "a snippet leaves a file behind"


@pytest.mark.slow
@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_tutorials_hold(page, page_runner, tmp_path):
    """Every tutorial checks a value itself."""
    assert "\nassert " in page.read_text()
    page_runner.run("\n".join(cells(page)), tmp_path)
    assert not list(tmp_path.iterdir()), "a tutorial leaves a file behind"


@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_tutorials_have_a_picture_and_use_public_names(page):
    text = page.read_text()
    assert "iw.plotting." in text or "Figure(" in text
    assert text.startswith("# %% [markdown]\n# # ")
    check_public(text)


@pytest.mark.slow
@pytest.mark.parametrize("page", REFERENCE, ids=lambda page: page.stem)
def test_examples_of_the_reference_hold(page, page_runner, tmp_path):
    """Every output is as the page says."""
    page_runner.run(CHECK_EXAMPLES.format(page=str(page)), tmp_path)
    assert not list(tmp_path.iterdir()), "an example leaves a file behind"


def test_reference_has_a_page_for_every_room():
    listed = {
        page.stem: re.findall(r"^```{names} (\S+)$", page.read_text(), re.M) for page in REFERENCE
    }
    assert listed.pop("index") == []
    assert listed == {"invertwin": ["invertwin"], **{room: [f"invertwin.{room}"] for room in ROOMS}}
    assert set(importlib.import_module("invertwin").__all__) - {"__version__"} <= {
        *ROOMS,
        *documented()["invertwin"],
    }


@pytest.mark.parametrize("room", documented())
def test_every_name_of_a_menu_has_an_example_that_runs_on_its_page(room):
    pages = [room.removeprefix("invertwin.")]
    pages += ["datasets"] if room == "invertwin" else []  # with the folder that `dataset` writes
    used = set().union(*(shown(REPOSITORY / "docs" / "api" / f"{page}.md") for page in pages))
    missing = [name for name in documented()[room] if f"{room}.{name}" not in used]
    assert not missing, f"no example on docs/api/{pages[0]}.md uses {', '.join(missing)}"


def test_a_name_that_is_only_imported_or_only_shares_its_word_is_not_used(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "```pycon\n"
        ">>> import invertwin as iw\n"
        ">>> from invertwin import capture\n"
        ">>> from invertwin.scene import box, plate as flat, sphere\n"
        ">>> box(1.0).plate, flat, capture.read, iw.FMCW.sphere\n"
        "```\n```python\nsphere(1.0)\n```\n"
    )
    names = {"scene.box", "scene.plate", "scene.sphere", "capture.read", "FMCW", "sphere"}
    assert {name for name in names if f"invertwin.{name}" in shown(page)} == names - {
        "scene.sphere",
        "sphere",
    }


def test_every_public_name_says_what_it_is():
    for room, names in documented().items():
        for name in names:
            thing = getattr(importlib.import_module(room), name)
            named = inspect.isclass(thing) or inspect.isroutine(thing)
            assert not named or thing.__doc__, f"{room}.{name} has no docstring"


def test_recipe_of_the_rail_data_makes_the_file_that_is_read(data_folder, tmp_path):
    made = "bwsi_rail_trial6.npz"
    with np.load(data_folder / "rail_sar" / made) as file:
        arrays = {name: file[name] for name in file.files if name != "meta"}
    recorded = arrays | {"range_bins": arrays["range_bins"][None]}  # as the original has it
    (tmp_path / "master_data.pkl").write_bytes(pickle.dumps(recorded))
    (recipe,) = cells(REPOSITORY / "docs" / "measured_data.md")
    run(["-c", recipe], tmp_path)
    with np.load(tmp_path / made) as file:
        for name, values in arrays.items():
            np.testing.assert_array_equal(file[name], values)
    taken, own = (rail_sar.read(folder) for folder in (tmp_path, data_folder / "rail_sar"))
    assert taken.dataset.identical(own.dataset)


def test_run_files_on_the_page_fit_the_schema(tmp_path):
    page = (REPOSITORY / "docs" / "run_files.md").read_text()
    examples = re.findall(r"^```toml\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert examples
    for text in examples:
        found = validate_run(tomllib.loads(text), tmp_path / "run.toml")
        (tmp_path / "run.toml").write_text(text)
        assert load_run(tmp_path / "run.toml") == found


@pytest.mark.slow
def test_run_file_on_the_page_finds_the_ball(tmp_path):
    page = (REPOSITORY / "docs" / "run_files.md").read_text()
    text, *_ = re.findall(r"^```toml\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    (tmp_path / "ball.toml").write_text(text)
    for command in ("simulate", "reconstruct"):
        line = ["-c", "from invertwin.cli.app import main; main()", command, "ball.toml"]
        run([*line, "--out", command], tmp_path)
    assert json.loads((tmp_path / "reconstruct" / "metrics.json").read_text())["success"]


def test_page_on_run_files_names_every_section():
    page = (REPOSITORY / "docs" / "run_files.md").read_text()
    table = page.split("## Which command needs what")[1].split("\n## ")[0]
    heads = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    named = {re.sub(r"\W*(\w+).*", r"\1", name) for c in heads for name in re.findall("`.+?`", c)}
    assert named == set(RunFile.model_fields)


@pytest.mark.slow
@pytest.mark.parametrize("script", EXAMPLES, ids=lambda script: script.name)
def test_examples_run(script, tmp_path):
    run([str(script)], tmp_path)
    for name in WRITES[script.name]:
        assert (tmp_path / "out" / "examples" / name).stat().st_size > 0


@pytest.mark.slow
def test_the_notebook_for_hosted_machines_shows_the_demo(tmp_path, monkeypatch):
    """Its lines of the shell, but pip, and its last cell."""
    shown = SimpleNamespace(HTML=lambda data: data)  # as notebooks have it
    monkeypatch.setitem(sys.modules, "IPython.display", shown)
    book = json.loads((REPOSITORY / "examples" / "colab.ipynb").read_text("utf-8"))
    texts = ["".join(cell["source"]) for cell in book["cells"] if cell["cell_type"] == "code"]
    assert "%pip install --quiet invertwin" in texts[0]
    for line in (text for text in texts if text.startswith("!invertwin ")):
        run(["-m", "invertwin", *line.split()[1:]], tmp_path)
    monkeypatch.chdir(tmp_path)
    body, _, last = texts[-1].rpartition("\n")
    names: dict = {}
    exec(body, names)
    assert "loss" in html.unescape(eval(last, names))


@pytest.mark.parametrize("script", EXAMPLES, ids=lambda script: script.name)
def test_examples_are_short_and_use_public_names(script):
    assert len(script.read_text().splitlines()) <= 60
    check_public(script.read_text())


def check_public(text):
    """Refuse what is not on a menu."""
    public = {
        "invertwin",
        *(f"invertwin.{room}" for room in [*importlib.import_module("invertwin").__all__, *ROOMS]),
    }
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("invertwin"):
            assert node.module in public
            assert {alias.name for alias in node.names} <= menu(node.module)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_names_exist(page):
    for name in set(NAME.findall(page.read_text())) - {PLUGINS}:
        assert resolved(name) is not None, f"{name} in {page.name}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_files_exist(page):
    text = page.read_text()
    for link in LINK.findall(text):
        if "://" not in link:
            assert (page.parent / link).exists(), f"{link} in {page.name}"
    for path in RUN_FILE.findall(text):
        assert list(REPOSITORY.glob(path)), f"{path} in {page.name}"


def test_every_difference_from_the_source_is_listed():
    page = (REPOSITORY / "docs" / "derivations.md").read_text()
    listed = set(NAME.findall(page.split("## Differs from the source")[1]))
    assert listed == set(differing())


def differing():
    """Qualified names of modules, classes and functions whose docstring has the remark."""
    sources = [REPOSITORY / "src", REPOSITORY / "experiments" / "studies" / "src"]
    for source, path in ((s, path) for s in sources for path in sorted(s.rglob("*.py"))):
        module = ".".join(path.relative_to(source).with_suffix("").parts)
        for node in ast.walk(ast.parse(path.read_text())):
            documented = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
            if documented and "Differs from the source" in (ast.get_docstring(node) or ""):
                yield module if isinstance(node, ast.Module) else f"{module}.{node.name}"


def resolved(name):
    """The object of a qualified name: a module, or an attribute of one, or of a class in one."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            found = getattr(found, part, None)
        return found
    return None
