"""Check whether this machine can trace rays: choose a libLLVM that works, report, name the cure.

On the CPU, Dr.Jit compiles its kernels with the system's libLLVM. Some versions are refused, and
some load and then abort the whole process in the first kernel with a minimum or a maximum, which
no ``except`` can catch. So every candidate is tried in a subprocess first, the newest that passes
is named in ``DRJIT_LIBLLVM_PATH`` before Dr.Jit is imported, and the verdict is kept on disk.
"""

import contextlib
import ctypes
import functools
import json
import logging
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import textwrap
import tomllib
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from invertwin.errors import InputError

LIBLLVM_VARIABLE = "DRJIT_LIBLLVM_PATH"
BACKEND_VARIABLE = "INVERTWIN_BACKEND"

# Dr.Jit must not go and find a library of its own when every one we know of fails.
_NO_LIBRARY = "no-usable-libLLVM--run-invertwin-doctor"

_FOLDERS = tomllib.loads(Path(__file__).with_name("llvm.toml").read_text())["folders"]
_LIBRARY = re.compile(r"libLLVM(-\d[\w.]*)?(\.\d[\d.]*)?\.(so|dylib)(\.\d[\w.]*)?$")
_PROBE_SECONDS = 60.0

_PROBE = """
import resource
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
import drjit as dr
from drjit.llvm.ad import Float, Float64, Int
total = 0.0
for kind in (Float, Float64, Int):
    x = dr.arange(kind, 64)
    y = dr.clip(dr.minimum(dr.maximum(x, kind(4)), kind(36)), kind(8), kind(32))
    dr.eval(y)
    total += float(sum(y))
assert total == 3 * 1556, total
print("passed")
"""

_SELF_TEST = """
import json, sys, time
import numpy as np
import drjit as dr
import mitsuba as mi
backend = sys.argv[1]
if backend == "auto":
    backend = "cuda" if dr.has_backend(dr.JitBackend.CUDA) else "cpu"
mi.set_variant({"cpu": "llvm", "cuda": "cuda"}[backend] + "_ad_mono_polarized")
n = 100
places = np.linspace(-1, 1, n)
u, v = np.meshgrid(places, places)
index = np.arange(n * n).reshape(n, n)
a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
faces = np.stack([a, b, c, b, d, c], -1).ravel()
mesh = mi.Mesh("relief", vertex_count=n * n, face_count=len(faces) // 3)
p = mi.traverse(mesh)
points = np.stack([u, v, 0.1 * np.sin(9 * u) * np.sin(9 * v)], -1).ravel()
p["vertex_positions"], p["faces"] = mi.Float(points), mi.UInt32(faces)
p.update()
scene = mi.load_dict({"type": "scene", "relief": mesh})
rays = 1_000_000 if backend == "cpu" else 16_000_000
def trace(seed):
    sampler = mi.PCG32(size=rays, initstate=seed)
    x, y = 2 * sampler.next_float32() - 1, 2 * sampler.next_float32() - 1
    ray = mi.Ray3f(mi.Point3f(0, 0, -2), dr.normalize(mi.Vector3f(x, y, 2)))
    return dr.sum(scene.ray_intersect_preliminary(ray).t, axis=None).numpy()
trace(0)
start, done = time.perf_counter(), 0
while time.perf_counter() - start < 1.0:
    done += 1
    trace(done)
print(json.dumps({"backend": backend, "threads": dr.thread_count(),
                  "rays_per_second": done * rays / (time.perf_counter() - start)}))
"""


@dataclass(frozen=True)
class LlvmLibrary:
    """A libLLVM on this machine.

    Attributes:
        path: The file, with links resolved; or what the user wrote, if that is no file.
        version: For example ``(19, 1)``; empty when neither file nor folder tells.
    """

    path: str
    version: tuple[int, ...]


@dataclass(frozen=True)
class LlvmProbeResult:
    """Result of a test kernel with a candidate library.

    Attributes:
        usable: The kernel ran and gave the right numbers.
        reason: One line.
        final: Worth remembering: running it again would end the same way.
    """

    usable: bool
    reason: str
    final: bool = True


@dataclass(frozen=True)
class _LlvmChoice:
    path: str | None
    problem: str = ""
    requested: str | None = None


_Probe = Callable[[str], LlvmProbeResult]
_choice: _LlvmChoice | None = None


def select_libllvm(folders: Sequence[Path] | None = None, probe: _Probe | None = None) -> None:
    """Set ``DRJIT_LIBLLVM_PATH`` to the newest libLLVM that passes, before Dr.Jit is imported.

    ``import invertwin`` calls it. It never raises: when nothing passes, :func:`require_backend`
    raises as soon as rays are needed. A path set by the user is kept if it passes, and replaced
    with a warning if not. Nothing is done when ``INVERTWIN_BACKEND=cuda``, nor on a second call.

    Args:
        folders: Folders to search, instead of the places known to hold libLLVM.
        probe: Judges one path, instead of :func:`probe_library`.
    """
    global _choice
    if _choice is not None or os.environ.get(BACKEND_VARIABLE) == "cuda":
        return
    _choice = _choose_library(folders, probe or probe_library)
    os.environ[LIBLLVM_VARIABLE] = _choice.path or _NO_LIBRARY


def require_backend(backend: str | None = None) -> None:
    """Raise unless rays can be traced.

    Args:
        backend: ``cpu``, ``cuda`` or ``auto``; default: ``INVERTWIN_BACKEND``, else ``auto``. Only
            the CPU needs libLLVM; ``auto`` is content with a GPU.

    Raises:
        InputError: No libLLVM passes. The message ends with the command that installs one.
    """
    backend = backend or os.environ.get(BACKEND_VARIABLE, "auto")
    if backend == "cuda":
        return
    select_libllvm()
    if _choice is None:
        raise InputError(
            f"expected a checked libLLVM for the CPU backend, got none as {BACKEND_VARIABLE}=cuda "
            f"skips the check; unset {BACKEND_VARIABLE} and start again"
        )
    if _choice.path is None and (backend == "cpu" or gpu_name() is None):
        raise InputError(
            f"expected a libLLVM that Dr.Jit can use, got {_choice.problem}; "
            f"type: {install_command()}"
        )


def find_libraries(folders: Iterable[Path] | None = None) -> list[LlvmLibrary]:
    """Every libLLVM in the given folders (default: system, conda, Homebrew), newest first."""
    found = {}
    for folder in _search_path() if folders is None else folders:
        for file in Path(folder).glob("libLLVM*"):
            if _LIBRARY.match(file.name) and file.is_file():
                path = os.path.realpath(file)
                version = _library_version(path) or _library_version(str(file))
                found[path] = max(found.get(path, ()), version)
    newest = sorted(((version, path) for path, version in found.items()), reverse=True)
    return [LlvmLibrary(path, version) for version, path in newest]


def probe_library(path: str) -> LlvmProbeResult:
    """Run a Dr.Jit kernel with this libLLVM in a subprocess, where an abort harms nobody."""
    with tempfile.TemporaryDirectory() as folder:
        # A kernel cached by another libLLVM would hide that this one cannot compile it.
        environment = os.environ | {LIBLLVM_VARIABLE: path, "DRJIT_CACHE_DIR": folder}
        try:
            ended = _run(_PROBE, environment, folder, timeout=_PROBE_SECONDS)
        except subprocess.TimeoutExpired:
            return LlvmProbeResult(False, f"no answer within {_PROBE_SECONDS:.0f} s", final=False)
        except OSError as error:
            return LlvmProbeResult(False, f"could not be tried: {error}", final=False)
    if ended.returncode == 0 and "passed" in ended.stdout:
        return LlvmProbeResult(True, "works")
    lines = [line.strip() for line in ended.stderr.splitlines() if line.strip()] or ["no message"]
    if ended.returncode < 0:
        # Killed from outside (memory, a time limit) says nothing about the library.
        final = -ended.returncode in (signal.SIGABRT, signal.SIGSEGV, signal.SIGILL)
        reason = f"aborts the process (signal {-ended.returncode}): {_shorten_message(lines[0])}"
        return LlvmProbeResult(False, reason, final)
    missing = re.search(r"ImportError: (\S+): cannot open shared object", ended.stderr)
    if missing:
        return LlvmProbeResult(False, f"could not be tried: Dr.Jit needs {missing[1]}", final=False)
    if lines[0].startswith("Traceback"):
        reason = f"could not be tried: {_shorten_message(lines[-1])}"
        return LlvmProbeResult(False, reason, final=False)
    reason = lines[0].split("(): ")[-1].split(". ")[0].rstrip(".")
    return LlvmProbeResult(False, f"refused: {_shorten_message(reason)}")


def _shorten_message(message: str) -> str:
    """A message without addresses of memory, cut between words."""
    return textwrap.shorten(re.sub(r":? ?\b0x[0-9a-f]+\b,?", "", message), 120, placeholder=" …")


def gpu_name() -> str | None:
    """The name of the first NVIDIA GPU that the driver shows to this process, or None."""
    # The tests and the report ask before any ray tracer is loaded, so the driver answers itself.
    try:
        driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return None
    device, name = ctypes.c_int(), ctypes.create_string_buffer(128)
    found = not (driver.cuInit(0) or driver.cuDeviceGet(ctypes.byref(device), 0))
    if not found or driver.cuDeviceGetName(name, len(name), device):
        return None
    return name.value.decode(errors="replace")


def install_command() -> str:
    """The one line that installs a libLLVM that works, and what else Dr.Jit needs of the system."""
    sudo = "" if getattr(os, "geteuid", lambda: 1)() == 0 else "sudo "
    if not os.environ.get("CONDA_PREFIX"):
        if sys.platform == "darwin":
            return "brew install llvm@19"
        if shutil.which("apt-get"):
            return f"{sudo}apt-get update && {sudo}apt-get install -y libllvm19 libatomic1"
        if shutil.which("dnf"):
            return f"{sudo}dnf install -y llvm-libs libatomic"
    return "conda install -c conda-forge libllvm19"


def collect_report() -> dict[str, Any]:
    """The state of this machine, for ``invertwin doctor``; takes a few seconds.

    Returns:
        ``ok``; ``versions`` by package; ``llvm`` (``chosen`` path, ``candidates`` with ``path``,
        ``version``, ``usable``, ``verdict``); ``backend`` (``requested``, ``in_force``, ``gpu``);
        ``threads``; ``self_test`` (``rays_per_second`` or ``error``); ``fix``: the command to type,
        or None. Plain values that JSON can hold.
    """
    requested = os.environ.get(BACKEND_VARIABLE, "auto")
    select_libllvm()
    examined = []
    for candidate in _add_explicit(find_libraries()):
        verdict = _probe_cached(candidate.path, probe_library)
        version = ".".join(map(str, candidate.version))
        status = {"usable": verdict.usable, "verdict": verdict.reason}
        examined.append({"path": candidate.path, "version": version, **status})
    gpu, fix = gpu_name(), None
    try:
        require_backend(requested)
        measured = _self_test(requested)
    except InputError as error:
        measured, fix = {"error": str(error).split("; type: ")[0]}, install_command()
    if requested == "cuda" and gpu is None:
        fix = f"unset {BACKEND_VARIABLE}"
    chosen = _choice.path if _choice else None
    return {
        "ok": "error" not in measured,
        "versions": {
            "invertwin": _package_version("invertwin"),
            "python": platform.python_version(),
            **{name: _package_version(name) for name in ("torch", "drjit", "mitsuba")},
        },
        "llvm": {"chosen": chosen and _resolve_path(chosen), "candidates": examined},
        "backend": {"requested": requested, "in_force": measured.pop("backend", None), "gpu": gpu},
        "threads": measured.pop("threads", os.cpu_count()),
        "self_test": measured,
        "fix": fix,
    }


def render_report(report: dict[str, Any]) -> str:
    """The report as text for a terminal."""
    llvm, backend, test = report["llvm"], report["backend"], report["self_test"]
    lines = [f"{name:<10} {version}" for name, version in report["versions"].items()]
    lines += ["", "libLLVM candidates, newest first" if llvm["candidates"] else "no libLLVM found"]
    for item in llvm["candidates"]:
        mark = "✓" if item["usable"] else "✗"
        chosen = "  ← chosen" if item["path"] == llvm["chosen"] else ""
        lines.append(f"  {mark} {item['version'] or '?':<8} {item['path']}{chosen}")
        lines += [] if item["usable"] else [f"      {item['verdict']}"]
    lines += [
        "",
        f"backend    {backend['in_force'] or 'none'} (requested: {backend['requested']})",
        f"GPU        {backend['gpu'] or 'none found'}",
        f"threads    {report['threads']}",
    ]
    if "rays_per_second" in test:
        lines.append(f"self-test  passed, {test['rays_per_second'] / 1e6:.1f} million rays/s")
    else:
        lines.append(f"self-test  failed: {test['error']}")
    if report["fix"]:
        # Sizes of libllvm19 in Debian 12 on x86-64.
        size = "  # downloads 26 MB, takes 126 MB" if "apt-get" in report["fix"] else ""
        lines += ["", f"To fix it, type:  {report['fix']}{size}"]
    return "\n".join(lines)


def _choose_library(folders: Sequence[Path] | None, probe: _Probe) -> _LlvmChoice:
    explicit = _explicit_path()
    complaint = ""
    if explicit:
        verdict = _probe_cached(explicit, probe)
        if verdict.usable:
            return _reject_if_loaded(_LlvmChoice(explicit, requested=explicit))
        complaint = f"{LIBLLVM_VARIABLE}={explicit} does not work ({verdict.reason})"
    seen = []
    for candidate in find_libraries(folders):
        verdict = _probe_cached(candidate.path, probe)
        if verdict.usable:
            if complaint:
                _warn(f"{complaint}; using {candidate.path}")
            return _reject_if_loaded(_LlvmChoice(candidate.path, requested=explicit))
        seen.append(f"{candidate.path} ({verdict.reason})")
    if complaint:
        _warn(f"{complaint}, and no other libLLVM does; 'invertwin doctor' says what to install")
        seen.insert(0, complaint)
    return _LlvmChoice(None, ", ".join(seen) or "none on this machine", explicit)


def _reject_if_loaded(choice: _LlvmChoice) -> _LlvmChoice:
    """The choice, unless Dr.Jit was imported earlier and has taken another libLLVM for itself."""
    drjit = sys.modules.get("drjit")
    if drjit is None or os.environ.get(LIBLLVM_VARIABLE) == choice.path:
        return choice
    loaded = tuple(drjit.detail.llvm_version())
    if loaded[:1] == _library_version(choice.path or "")[:1]:
        return choice
    version = ".".join(map(str, loaded))
    why = "as Dr.Jit was imported first (import invertwin before it)"
    return _LlvmChoice(None, f"libLLVM {version}, {why}")


def _explicit_path() -> str | None:
    """The user's own choice of libLLVM, if there is one."""
    value = os.environ.get(LIBLLVM_VARIABLE)
    return value if value and value != _NO_LIBRARY else None


def _add_explicit(found: list[LlvmLibrary]) -> list[LlvmLibrary]:
    asked = _choice.requested if _choice else _explicit_path()
    if asked is None or _resolve_path(asked) in {c.path for c in found}:
        return found
    return [LlvmLibrary(_resolve_path(asked), _library_version(asked)), *found]


def _resolve_path(path: str) -> str:
    # A bare name such as "libLLVM-19.so" is for the system's loader to find: leave it.
    return os.path.realpath(path) if os.path.exists(path) else path


def _search_path() -> list[Path]:
    roots = [os.environ.get("CONDA_PREFIX"), os.environ.get("HOMEBREW_PREFIX"), sys.prefix]
    listed = os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep)
    folders = [Path(folder) for folder in listed if folder]
    for root in filter(None, roots):
        folders += [Path(root, "lib"), *Path(root, "opt").glob("llvm*/lib")]
    for pattern in _FOLDERS:
        folders += Path("/").glob(pattern.removeprefix("/"))
    return folders


def _library_version(path: str) -> tuple[int, ...]:
    """(19, 1) of libLLVM.so.19.1, libLLVM-19.so or /usr/lib/llvm-19/lib/libLLVM.so."""
    match = _LIBRARY.match(os.path.basename(path))
    before, within, _, after = match.groups() if match else (None,) * 4
    # The suffix comes last: the ".1" of libLLVM-14.so.1 counts revisions of the file, not of LLVM.
    for text in (before, within, *re.findall(r"/llvm[-@/]?(\d[\d.]*)", path), after):
        numbers = re.match(r"[-.]?(\d+(?:\.\d+)*)", text or "")
        if numbers:
            return tuple(int(part) for part in numbers.group(1).split("."))
    return ()


def _probe_cached(path: str, probe: _Probe) -> LlvmProbeResult:
    """The verdict on a path from the disk, or from the probe, which is then remembered."""
    try:
        status = os.stat(path)
    except OSError:
        return probe(path)
    library = f"{os.path.realpath(path)}|{status.st_mtime_ns}|{status.st_size}"
    python = f"python {platform.python_version()} {platform.machine()}"
    probed = f"drjit {_package_version('drjit')}|{python}|probe {zlib.crc32(_PROBE.encode())}"
    key = f"{library}|{probed}"
    known = _read_cache()
    if key in known:
        return known[key]
    verdict = probe(path)
    if verdict.final:
        _write_cache(_read_cache() | {key: verdict})
    return verdict


def cache_folder() -> Path:
    """Return the folder of caches on disk; it may not exist."""
    home = os.path.expanduser("~")
    # Without a home there is no cache: nothing can be written below a file.
    own = os.devnull if home.startswith("~") else os.path.join(home, ".cache")
    return Path(os.environ.get("XDG_CACHE_HOME") or own, "invertwin")


def _cache_file() -> Path:
    return cache_folder() / "llvm.json"


def _read_cache() -> dict[str, LlvmProbeResult]:
    try:
        entries = json.loads(_cache_file().read_text(encoding="utf-8"))
        return {key: LlvmProbeResult(**entry) for key, entry in entries.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}  # missing, or spoilt: the verdicts are simply found again


def _write_cache(verdicts: dict[str, LlvmProbeResult]) -> None:
    file = _cache_file()
    entries = {key: vars(verdict) for key, verdict in verdicts.items()}
    # Without a place to write, the next import probes again: slower, not wrong.
    with contextlib.suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        part = file.with_name(f"{file.name}.{os.getpid()}")
        part.write_text(json.dumps(entries, indent=1), encoding="utf-8")
        part.replace(file)


def _self_test(requested: str) -> dict[str, Any]:
    try:
        ended = _run(_SELF_TEST, dict(os.environ), None, requested, timeout=120.0)
    except subprocess.TimeoutExpired:
        return {"error": "no answer within 120 s"}
    if ended.returncode:
        said = ended.stderr.strip().splitlines() or ["no message"]
        return {"error": f"exit code {ended.returncode}: {said[-1]}"}
    return json.loads(ended.stdout.splitlines()[-1])


def _run(
    code: str, environment: dict[str, str], folder: str | None, *arguments: str, timeout: float
) -> subprocess.CompletedProcess[str]:
    # -P: a file in the current folder must not stand in for a module.
    command = [sys.executable, "-P", "-c", code, *arguments]
    streams: Any = {"capture_output": True, "text": True, "errors": "replace"}
    place: Any = {"env": environment, "cwd": folder, "stdin": subprocess.DEVNULL}
    return subprocess.run(command, timeout=timeout, check=False, **streams, **place)


@functools.cache
def _package_version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _warn(message: str) -> None:
    # Not `warnings`: turned into errors, it would break the import; and it takes two lines.
    logging.getLogger("invertwin").warning("invertwin: %s", message)
