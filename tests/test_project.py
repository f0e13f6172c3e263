"""The public menu and the project's own files agree with each other."""

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
    with pytest.raises(AttributeError, match="module 'invertwin' has no attribute 'Scen'"):
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
