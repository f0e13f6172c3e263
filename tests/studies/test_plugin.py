"""The studies are a plugin; without it, in a bare wheel, errors say how to get it."""

import subprocess
import sys
import tomllib

import pytest

from cli.small import GRADCHECK, RUN
from invertwin.cli.schema import RunFile
from invertwin_studies.sections import LossScan, Methods

# What `invertwin` is where no plugin is installed.
BARE = (
    "import importlib.metadata, sys; importlib.metadata.entry_points = lambda **_: []; "
    "from invertwin.cli.app import main; sys.argv = sys.argv[1:]; main()"
)


def bare(folder, *arguments):
    return subprocess.run(
        [sys.executable, "-c", BARE, "invertwin", *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
    )


def test_sections_and_commands_are_there():
    fields = RunFile.model_fields
    assert fields["methods"].annotation == Methods | None
    assert fields["loss_scan"].annotation == LossScan | None
    assert "other ways to the derivative" in (fields["methods"].description or "").lower()
    told = subprocess.run(
        [sys.executable, "-c", "from invertwin.cli.app import main; main()", "--help"],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    assert {"loss-scan", "train-prior"} <= {*told.split()}


@pytest.mark.slow
@pytest.mark.parametrize("section", ["methods", "loss_scan"])
def test_a_bare_wheel_says_what_to_install(tmp_path, section):
    text = RUN.replace('task = "reconstruct"', 'task = "gradcheck"')
    (tmp_path / "run.toml").write_text(f"{text}{GRADCHECK}\n[{section}]\nsources = 3\n")
    ended = bare(tmp_path, "gradcheck", "run.toml")
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1
    assert f"run.toml: {section}: expected one of the keys task, " in ended.stderr
    assert "install the studies: pip install -e ./experiments/studies" in ended.stderr


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["openradar", "rail_sar"])
def test_a_bare_wheel_says_what_reads_a_public_recording(tmp_path, kind):
    head, rest = RUN.split("[data]", 1)
    rest = rest[rest.index("\n[") :]
    (tmp_path / "run.toml").write_text(f'{head}[data]\nkind = "{kind}"\nfolder = "."\n{rest}')
    ended = bare(tmp_path, "reconstruct", "run.toml")
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1
    assert "run.toml: data.kind: expected one of simulated, " in ended.stderr
    assert "install the studies: pip install -e ./experiments/studies" in ended.stderr


def test_a_bare_wheel_lacks_the_commands(tmp_path):
    ended = bare(tmp_path, "train-prior")
    assert ended.returncode == 2
    assert "No such command 'train-prior'" in ended.stderr


def test_the_wheel_holds_no_studies(repository):
    project = tomllib.loads((repository / "pyproject.toml").read_text())
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert wheel["packages"] == ["src/invertwin", "src/invertwin_convert"]
    assert not any("studies" in source for source in wheel["force-include"])
    studies = tomllib.loads((repository / "experiments/studies/pyproject.toml").read_text())
    plugins = studies["project"]["entry-points"]["invertwin.plugins"]
    assert plugins == {"studies": "invertwin_studies:register"}
