"""The public menu and the project's own files agree with each other."""

import importlib
import json
import re
import subprocess
import sys
import tomllib

import pytest

import invertwin

NAME = re.compile(r"[A-Za-z0-9_.-]+")


def canonical(requirement: str) -> str:
    match = NAME.match(requirement)
    assert match, requirement
    return match.group().lower().replace("_", "-")


@pytest.fixture(scope="module")
def project(repository):
    return tomllib.loads((repository / "pyproject.toml").read_text())["project"]


@pytest.fixture(scope="module")
def pinned(repository):
    lines = (repository / "constraints.txt").read_text().splitlines()
    return [line for line in lines if line and not line.startswith("#")]


@pytest.mark.parametrize("name", invertwin.__all__)
def test_every_name_on_the_menu_is_there(name):
    assert getattr(invertwin, name) is not None
    assert name in dir(invertwin)


def test_a_name_that_is_not_on_the_menu_is_an_attribute_error():
    with pytest.raises(AttributeError, match="No invertwin attribute Scen"):
        _ = invertwin.Scen


def test_every_dependency_has_an_exact_version(project, pinned):
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+", line) for line in pinned)
    groups = [project["dependencies"], *project["optional-dependencies"].values()]
    wanted = {canonical(requirement) for group in groups for requirement in group}
    assert wanted <= {canonical(line) for line in pinned}


def test_importing_the_package_loads_no_ray_tracer():
    code = "import sys, invertwin; print(*{'drjit', 'mitsuba', 'torch'} & set(sys.modules))"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.strip() == ""


def test_python_in_the_makefile_names_functions_that_exist(repository):
    makefile = (repository / "Makefile").read_text()
    calls = re.findall(r"from (invertwin[.\w]*) import (\w+); (.+)'", makefile)
    assert len(calls) == makefile.count("-c 'from invertwin")
    for package, module, code in calls:
        imported = importlib.import_module(f"{package}.{module}")
        functions = re.findall(rf"\b{module}\.(\w+)", code)
        assert functions
        assert [name for name in functions if not hasattr(imported, name)] == []


def test_the_container_runs_what_the_makefile_has(repository):
    folder = repository / ".devcontainer"
    settings = json.loads((folder / "devcontainer.json").read_text())
    dockerfile = folder / settings["build"]["dockerfile"]
    assert (folder / settings["build"]["context"]).samefile(repository)
    assert dockerfile.samefile(repository / "Dockerfile")
    text, makefile = dockerfile.read_text(), (repository / "Makefile").read_text()
    assert f" AS {settings['build']['target']}\n" in text
    assert settings["postCreateCommand"] == "make demo"
    run = [line for line in text.splitlines() if line.startswith(("RUN make", "CMD"))]
    targets = set(re.findall(r"[.\w/]+", " ".join(run))) - {"RUN", "CMD", "make"}
    assert targets == {".venv/.run", ".venv/.llvm", "demo"}
    assert all(re.search(rf"^{re.escape(name)}:", makefile, re.MULTILINE) for name in targets)
    assert {"libllvm19", "libatomic1", "make"} <= set(text.split())


def test_every_dependency_has_its_licence_in_the_notice(project, repository):
    lines = (repository / "NOTICE").read_text().splitlines()
    listed = {canonical(line[2:]) for line in lines if line.startswith("- ") and ": " in line}
    assert {canonical(requirement) for requirement in project["dependencies"]} <= listed


def test_every_bundled_file_is_in_the_notice(repository):
    package = repository / "src" / "invertwin"
    found = [f for f in package.rglob("*") if f.is_file() and "__pycache__" not in f.parts]
    bundled = {f.name for f in found if f.suffix != ".py"} - {"py.typed"}
    notice = (repository / "NOTICE").read_text()
    assert {name for name in bundled if name not in notice} == set()


# What conda-forge calls a package that PyPI calls otherwise.
CONDA = {"torch": "pytorch", "libigl": "igl", "matplotlib": "matplotlib-base"}


def test_the_recipe_has_the_version_and_requirements_of_the_project(project, repository):
    recipe = (repository / "conda" / "recipe.yaml").read_text()
    assert f'version: "{invertwin.__version__}"' in recipe
    (run,) = re.findall(r"^  run:\n((?:    - .+\n)+)", recipe, re.M)
    listed = {line.removeprefix("    - ").replace(" ", "") for line in run.splitlines()}
    expected = {f"python{project['requires-python']}"}
    for requirement in project["dependencies"]:
        name = requirement.split(">")[0]
        expected.add(CONDA.get(name, name) + requirement.removeprefix(name))
    assert listed == expected
    assert f"license: {project['license']}\n" in recipe
    assert f'summary: "{project["description"]}"' in recipe
    (script,) = re.findall(r"- (invertwin = .+)", recipe)
    assert script.split(" = ") == ["invertwin", project["scripts"]["invertwin"]]


def test_the_citation_has_the_version(repository):
    assert f"\nversion: {invertwin.__version__}\n" in (repository / "CITATION.cff").read_text()


def test_the_changelog_begins_with_what_is_not_released_or_this_version(repository):
    first, *others = re.findall(r"^## (.+)$", (repository / "CHANGELOG.md").read_text(), re.M)
    assert first == "Unreleased" or first.startswith(invertwin.__version__)
    assert any(head.startswith(invertwin.__version__) for head in [first, *others])


def test_the_sdist_has_what_its_tests_read(repository):
    build = tomllib.loads((repository / "pyproject.toml").read_text())["tool"]["hatch"]["build"]
    held = set(build["targets"]["sdist"]["include"])
    assert {"src", "tests", "docs", "examples", "experiments", "conda", "benchmarks"} <= held
    assert {"CITATION.cff", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md"} <= held
