"""The wheel where nothing helps it: another user, an odd folder, no HOME, rights or locale."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import invertwin

ROOT = Path(__file__).parents[1]
NOBODY = 65534
#: A user who may read all, since Python may lie in another's home, and write nothing of others.
AS_NOBODY = (
    *("setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups"),
    *("--inh-caps=-all,+dac_read_search", "--ambient-caps=+dac_read_search"),
    *("--bounding-set=-all,+dac_read_search", "--"),
)


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """What the wheel holds, in a folder that nobody may write to."""
    folder = tmp_path_factory.mktemp("wheel")
    call = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", str(ROOT), "-w", folder]
    built = subprocess.run(call, capture_output=True, text=True)
    if built.returncode:
        pytest.skip(f"no wheel without a network: {built.stderr[-100:]}")
    (wheel,) = folder.glob("*.whl")
    site = folder / "site packages"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    for path in (site, *site.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    return site


@pytest.fixture
def folder(tmp_path):
    """A folder of that user's, whose name is none that a shell would like."""
    odd = tmp_path / "a ü\n'b\" c"
    odd.mkdir()
    os.chown(odd, NOBODY, NOBODY)
    return odd


@pytest.mark.slow
@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() != 0 or shutil.which("setpriv") is None,
    reason="needs: root, who can be another user, and setpriv",
)
@pytest.mark.parametrize("words", [["doctor"], ["new", "simulate", "ü.toml"], ["demo"]])
def test_the_wheel_runs_where_nothing_helps_it(installed, folder, words):
    kept = {name: os.environ[name] for name in ("PATH", "LD_LIBRARY_PATH") if name in os.environ}
    env = kept | {"PYTHONPATH": str(installed), "LC_ALL": "C", "PYTHONCOERCECLOCALE": "0"}
    before = {path: path.stat().st_mtime_ns for path in installed.rglob("*")}
    where = "import invertwin, sys; sys.stdout.write(invertwin.__file__)"
    told = subprocess.run(
        [*AS_NOBODY, sys.executable, "-P", "-c", where], cwd=folder, env=env, capture_output=True
    )
    assert Path(told.stdout.decode()).parents[1] == installed, told.stderr
    done = subprocess.run(
        [*AS_NOBODY, sys.executable, "-P", "-m", "invertwin", *words],
        cwd=folder,
        env=env,
        umask=0o077,
        capture_output=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert b"Traceback" not in done.stderr
    assert {path: path.stat().st_mtime_ns for path in installed.rglob("*")} == before
    assert not (folder / "~").exists()
    if words == ["demo"]:
        report = folder / "out" / "demo" / "report.html"
        assert invertwin.__version__ in report.read_text(encoding="utf-8")
        assert (report.stat().st_uid, report.stat().st_mode & 0o077) == (NOBODY, 0)
