"""Which libLLVM is chosen, whatever the machine has; and what is said when none will do."""

import itertools
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from invertwin.errors import InputError
from invertwin.runtime import doctor

VERSIONS = (14, 15, 19)
SUBSETS = [subset for size in range(4) for subset in itertools.combinations(VERSIONS, size)]


class FakeProbe:
    """Judges by name as the real libraries do, and counts how often it is asked."""

    def __init__(self, working=(19,)):
        self.working = working
        self.asked = []

    def __call__(self, path):
        self.asked.append(path)
        if any(str(version) in Path(path).name for version in self.working):
            return doctor.LlvmProbeResult(True, "works")
        return doctor.LlvmProbeResult(False, "aborts the process")


@pytest.fixture(autouse=True)
def fresh_doctor(monkeypatch, tmp_path):
    """A process that has not chosen yet, with an empty cache."""
    monkeypatch.setattr(doctor, "_choice", None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv(
        doctor.LIBLLVM_VARIABLE, ""
    )  # so that what a test leaves there is taken back
    monkeypatch.delenv(doctor.LIBLLVM_VARIABLE)
    monkeypatch.delenv(doctor.BACKEND_VARIABLE, raising=False)
    monkeypatch.setattr(doctor, "gpu_name", lambda: None)
    # Dr.Jit may be loaded in this process by other tests; here it is not.
    monkeypatch.delitem(sys.modules, "drjit", raising=False)


def machine(root: Path, versions) -> list[Path]:
    """System folders as Debian lays them out, links included."""
    system = root / "usr/lib/x86_64-linux-gnu"
    system.mkdir(parents=True)
    folders = [system]
    (system / "libLLVMfoo.so").write_text("another library")
    for version in versions:
        name = f"libLLVM.so.{version}.1" if version >= 18 else f"libLLVM-{version}.so.1"
        (system / name).write_text(f"LLVM {version}")
        (system / f"libLLVM-{version}.so").symlink_to(name)
        private = root / f"usr/lib/llvm-{version}/lib"
        private.mkdir(parents=True)
        (private / "libLLVM.so").symlink_to(system / name)
        (private / "libLLVMCore.a").write_text("")
        folders.append(private)
    return folders


def library(folders, version):
    return next(c.path for c in doctor.find_libraries(folders) if c.version[0] == version)


@pytest.mark.parametrize("present", SUBSETS)
def test_every_library_is_found_once_newest_first(tmp_path, present):
    found = doctor.find_libraries(machine(tmp_path, present))
    assert [c.version[0] for c in found] == sorted(present, reverse=True)


@pytest.mark.parametrize("explicit", [None, *VERSIONS])
@pytest.mark.parametrize("present", SUBSETS)
def test_the_newest_that_passes_is_chosen(tmp_path, monkeypatch, caplog, present, explicit):
    folders = machine(tmp_path / "system", present)
    own = tmp_path / "own" / f"libLLVM-{explicit}.so"
    if explicit:
        own.parent.mkdir()
        own.write_text("LLVM of the user's own")
        monkeypatch.setenv(doctor.LIBLLVM_VARIABLE, str(own))
    doctor.select_libllvm(folders, FakeProbe())

    set_to = os.environ[doctor.LIBLLVM_VARIABLE]
    if explicit == 19:
        assert set_to == str(own)
    elif 19 in present:
        assert set_to == library(folders, 19)
    else:
        assert not os.path.exists(set_to)
        with pytest.raises(InputError, match=r"libllvm19|llvm@19|llvm-libs"):
            doctor.require_backend()
    warned = explicit in (14, 15)
    assert len(caplog.messages) == warned
    assert all("\n" not in message and str(own) in message for message in caplog.messages)


def test_older_but_working_is_chosen_when_the_newest_fails(tmp_path):
    folders = machine(tmp_path, VERSIONS)
    doctor.select_libllvm(folders, FakeProbe(working=(14,)))
    assert os.environ[doctor.LIBLLVM_VARIABLE] == library(folders, 14)


@pytest.mark.parametrize(
    ("file", "version"),
    [
        ("/usr/lib/libLLVM.so.19.1", (19, 1)),
        ("/usr/lib/libLLVM-14.0.6.so", (14, 0, 6)),
        ("/usr/lib/libLLVM-14.so.1", (14,)),
        ("/usr/lib/llvm-17/lib/libLLVM.so.1", (17,)),
        ("/usr/lib/llvm-17/lib/libLLVM.so", (17,)),
        ("/opt/homebrew/opt/llvm@19/lib/libLLVM.dylib", (19,)),
        ("/opt/homebrew/Cellar/llvm/19.1.7/lib/libLLVM.dylib", (19, 1, 7)),
        ("/env/lib/libLLVM.19.1.dylib", (19, 1)),
        ("/env/lib/libLLVM.so", ()),
    ],
)
def test_version_of_a_file(file, version):
    assert doctor._library_version(file) == version


def test_no_library_at_all_raises_one_line_only_when_rays_are_needed(tmp_path, monkeypatch):
    doctor.select_libllvm([tmp_path], FakeProbe())
    with pytest.raises(InputError, match="got none on this machine; type: ") as error:
        doctor.require_backend()
    assert "\n" not in str(error.value)
    monkeypatch.setattr(doctor, "gpu_name", lambda: "A GPU")
    doctor.require_backend()
    doctor.require_backend("cuda")
    with pytest.raises(InputError, match="type: "):
        doctor.require_backend("cpu")


def test_a_child_process_does_not_take_our_mark_for_the_users_choice(tmp_path, monkeypatch, caplog):
    doctor.select_libllvm([tmp_path], FakeProbe())
    monkeypatch.setattr(doctor, "_choice", None)
    probe = FakeProbe()
    doctor.select_libllvm([tmp_path], probe)
    assert probe.asked == []
    assert caplog.messages == []


def test_the_cuda_backend_costs_no_probe(tmp_path, monkeypatch):
    monkeypatch.setenv(doctor.BACKEND_VARIABLE, "cuda")
    probe = FakeProbe()
    doctor.select_libllvm(machine(tmp_path, VERSIONS), probe)
    assert probe.asked == []
    assert doctor.LIBLLVM_VARIABLE not in os.environ
    doctor.require_backend()
    with pytest.raises(InputError, match="unset INVERTWIN_BACKEND"):
        doctor.require_backend("cpu")


def test_dr_jit_imported_first_with_a_bad_library_is_noticed(tmp_path, monkeypatch):
    class Loaded:
        class detail:  # noqa: N801
            @staticmethod
            def llvm_version():
                return (15, 0, 6)

    monkeypatch.setitem(sys.modules, "drjit", Loaded)
    doctor.select_libllvm(machine(tmp_path, VERSIONS), FakeProbe())
    with pytest.raises(InputError, match=r"libLLVM 15\.0\.6, as Dr\.Jit was imported first"):
        doctor.require_backend("cpu")


class TestCache:
    def choose(self, monkeypatch, folders, probe):
        monkeypatch.setattr(doctor, "_choice", None)
        monkeypatch.delenv(doctor.LIBLLVM_VARIABLE, raising=False)
        doctor.select_libllvm(folders, probe)
        return os.environ[doctor.LIBLLVM_VARIABLE]

    def test_a_second_import_asks_nothing(self, tmp_path, monkeypatch):
        folders = machine(tmp_path, VERSIONS)
        first, second = FakeProbe(working=(15,)), FakeProbe(working=())
        chosen = self.choose(monkeypatch, folders, first)
        assert len(first.asked) == 2  # 19 and 15; 14 is never needed
        assert self.choose(monkeypatch, folders, second) == chosen
        assert second.asked == []

    def test_a_changed_library_is_tried_again(self, tmp_path, monkeypatch):
        folders = machine(tmp_path, VERSIONS)
        self.choose(monkeypatch, folders, FakeProbe())
        os.utime(library(folders, 19), (1, 1))
        probe = FakeProbe()
        self.choose(monkeypatch, folders, probe)
        assert probe.asked == [library(folders, 19)]

    def test_another_dr_jit_is_another_question(self, tmp_path, monkeypatch):
        folders = machine(tmp_path, VERSIONS)
        self.choose(monkeypatch, folders, FakeProbe())
        monkeypatch.setattr(doctor, "_package_version", lambda name: "99")
        probe = FakeProbe()
        self.choose(monkeypatch, folders, probe)
        assert probe.asked == [library(folders, 19)]

    @pytest.mark.parametrize(
        "spoilt", ["", "{", "[]", "7", '{"a": 1}', '{"a": {"usable": true}}', "\udcff"]
    )
    def test_a_spoilt_cache_is_found_again(self, tmp_path, monkeypatch, spoilt):
        folders = machine(tmp_path, VERSIONS)
        self.choose(monkeypatch, folders, FakeProbe())
        doctor._cache_file().write_bytes(spoilt.encode(errors="surrogateescape"))
        assert self.choose(monkeypatch, folders, FakeProbe()) == library(folders, 19)
        assert json.loads(doctor._cache_file().read_text())
        assert [f.name for f in doctor._cache_file().parent.iterdir()] == ["llvm.json"]

    def test_no_place_to_write_is_no_obstacle(self, tmp_path, monkeypatch):
        folders = machine(tmp_path, VERSIONS)
        blocked = tmp_path / "blocked"
        blocked.write_text("a file, not a folder")
        monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
        assert self.choose(monkeypatch, folders, FakeProbe()) == library(folders, 19)

    def test_a_passing_trouble_is_not_remembered(self, tmp_path, monkeypatch):
        folders = machine(tmp_path, VERSIONS)
        self.choose(
            monkeypatch, folders, lambda path: doctor.LlvmProbeResult(False, "busy", final=False)
        )
        assert self.choose(monkeypatch, folders, FakeProbe()) == library(folders, 19)


class TestRealLibraries:
    """The libraries of this machine, in subprocesses."""

    def real(self, version):
        found = [c.path for c in doctor.find_libraries() if c.version[:1] == (version,)]
        if not found:
            pytest.skip(f"no libLLVM {version} on this machine")
        return found[0]

    def test_llvm_14_is_refused(self):
        verdict = doctor.probe_library(self.real(14))
        assert not verdict.usable
        assert "too old" in verdict.reason

    def test_llvm_15_aborts_the_probe_and_nothing_else(self):
        verdict = doctor.probe_library(self.real(15))
        assert not verdict.usable
        assert verdict.final
        assert "aborts the process" in verdict.reason

    def test_llvm_19_works(self):
        assert doctor.probe_library(self.real(19)) == doctor.LlvmProbeResult(True, "works")

    def test_a_file_that_is_no_library_is_refused(self, tmp_path):
        file = tmp_path / "libLLVM-19.so"
        file.write_text("not a library")
        assert not doctor.probe_library(str(file)).usable

    def test_what_dr_jit_itself_lacks_is_named_and_not_blamed_on_the_library(
        self, tmp_path, monkeypatch
    ):
        said = (
            "ImportError: libatomic.so.1: cannot open shared object file: No such file\nNameError"
        )
        ended = subprocess.CompletedProcess(
            [], 1, "", f"Traceback (most recent call last):\n{said}"
        )
        monkeypatch.setattr(doctor, "_run", lambda *_, **__: ended)
        verdict = doctor.probe_library("libLLVM-19.so")
        assert verdict == doctor.LlvmProbeResult(
            False, "could not be tried: Dr.Jit needs libatomic.so.1", final=False
        )

    @pytest.mark.parametrize("asked", [14, 15])
    def test_importing_with_a_bad_library_named_warns_and_works(self, asked):
        """The abort that LLVM 15 causes never reaches the user, even who asks for it."""
        good = self.real(19)
        kernel = (
            "import os, invertwin, drjit as dr\n"
            "from drjit.llvm.ad import Float\n"
            "print(dr.clip(dr.arange(Float, 4), 1, 2)[3], os.environ['DRJIT_LIBLLVM_PATH'])"
        )
        ended = subprocess.run(
            [sys.executable, "-c", kernel],
            env=os.environ | {doctor.LIBLLVM_VARIABLE: self.real(asked)},
            capture_output=True,
            text=True,
            check=True,
        )
        assert ended.stdout.split() == ["2.0", good]
        assert ended.stderr.count("\n") == 1
        assert f"using {good}" in ended.stderr

    def test_report(self, monkeypatch):
        self.real(19)
        monkeypatch.setenv(doctor.BACKEND_VARIABLE, "cpu")
        report = doctor.collect_report()
        assert report["ok"]
        assert report["fix"] is None
        assert report["backend"] == {"requested": "cpu", "in_force": "cpu", "gpu": None}
        assert report["self_test"]["rays_per_second"] > 1e5
        assert json.loads(json.dumps(report)) == report
        text = doctor.render_report(report)
        assert f"{report['llvm']['chosen']}  ← chosen" in text
        assert "million rays/s" in text


def test_report_without_any_library_names_the_cure(tmp_path):
    doctor.select_libllvm([tmp_path], FakeProbe())
    report = doctor.collect_report()
    assert not report["ok"]
    assert report["fix"] == doctor.install_command()
    text = doctor.render_report(report)
    assert f"To fix it, type:  {report['fix']}" in text
    assert ("downloads 26 MB" in text) == ("apt-get" in report["fix"])


@pytest.mark.parametrize(
    ("conda", "platform", "tools", "root", "command"),
    [
        (
            False,
            "linux",
            {"apt-get"},
            True,
            "apt-get update && apt-get install -y libllvm19 libatomic1",
        ),
        (
            False,
            "linux",
            {"apt-get"},
            False,
            "sudo apt-get update && sudo apt-get install -y libllvm19 libatomic1",
        ),
        (False, "linux", {"dnf"}, False, "sudo dnf install -y llvm-libs libatomic"),
        (False, "linux", set(), False, "conda install -c conda-forge libllvm19"),
        (False, "darwin", set(), False, "brew install llvm@19"),
        (True, "linux", {"apt-get"}, True, "conda install -c conda-forge libllvm19"),
    ],
)
def test_install_command(monkeypatch, conda, platform, tools, root, command):
    if conda:
        monkeypatch.setenv("CONDA_PREFIX", "/conda")
    else:
        monkeypatch.delenv("CONDA_PREFIX", raising=False)
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(doctor.shutil, "which", lambda name: name if name in tools else None)
    monkeypatch.setattr(doctor.os, "geteuid", lambda: 0 if root else 1000)
    assert doctor.install_command() == command


def test_without_a_home_there_is_no_cache(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)
    with pytest.raises(OSError, match="Not a directory"):
        doctor.cache_folder().mkdir(parents=True, exist_ok=True)
    assert list(tmp_path.iterdir()) == []
