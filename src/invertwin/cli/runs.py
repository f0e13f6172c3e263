"""Run folders: what a run leaves on disk, and the rule that no result is ever lost.

A folder is owned through a manifest of the files that the run has written, so a folder that also
holds the user's own files is safe: only listed files are moved or removed.
"""

import hashlib
import json
import math
import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from invertwin.cli.run_file import to_toml
from invertwin.errors import InputError

if TYPE_CHECKING:  # Matplotlib takes half a second, and most errors come before any figure
    from matplotlib.figure import Figure

MANIFEST = ".invertwin.json"
PREVIOUS = ".previous"
CHECKPOINT = "checkpoint.pt"
PARTS = "parts"  # finished and unfinished parts of a run, until it ends
RESULTS = ("metrics.json", "run.toml", "report.html", "twin.ply", CHECKPOINT)


class RunFolder:
    """The folder of one run, from `open_run`; use it as a context manager.

    Leaving the block normally completes the run and drops the results it replaces. An
    interruption keeps what can be resumed. Any other exception puts back what was there before.
    """

    def __init__(self, path: Path, manifest: dict[str, Any], *, resumed: bool):
        self.path = path
        self.resumed = resumed
        self._manifest = manifest

    def __enter__(self) -> "RunFolder":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: object) -> None:
        if kind is None:
            self._manifest["complete"] = True
            self._save_manifest()
            shutil.rmtree(self.path / PREVIOUS, ignore_errors=True)
        elif self.resumable and (
            issubclass(kind, KeyboardInterrupt)
            or self.resumed
            or not (self.path / PREVIOUS).exists()
        ):
            return
        else:
            self._undo()

    @property
    def resumable(self) -> bool:
        """Whether this run left something to go on from."""
        return any(
            (name == CHECKPOINT or name.startswith(PARTS)) and (self.path / name).exists()
            for name in self._manifest["files"]
        )

    @property
    def complete(self) -> bool:
        """Whether the run had ended before it was opened again."""
        return self._manifest["complete"]

    @property
    def names(self) -> tuple[str, ...]:
        """The result files of this run."""
        return tuple(self._manifest["files"])

    @property
    def run_files(self) -> dict[str, str]:
        """The run files as used, by their path in the folder."""
        found = [name for name in self.names if name == "run.toml" or name.startswith("runs/")]
        return {name: (self.path / name).read_text(encoding="utf-8") for name in found}

    def file(self, name: str) -> Path:
        """The path of a result file, owned by this run from now on."""
        if name not in self._manifest["files"]:
            self._manifest["files"].append(name)
            self._save_manifest()
        path = self.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def write_bytes(self, name: str, data: bytes) -> None:
        """Write a result file so that a kill leaves the old or the new one, never half of it."""
        _replace(self.file(name), data)

    def write_figure(self, name: str, figure: "Figure") -> bytes:
        """Write a figure as PNG, and return its bytes."""
        from invertwin.plotting import png_bytes

        png = png_bytes(figure)
        self.write_bytes(name, png)
        return png

    def write_text(self, name: str, text: str) -> None:
        """Write a result file as UTF-8, in the way of `write_bytes`."""
        self.write_bytes(name, text.encode("utf-8"))

    def write_json(self, name: str, value: Any) -> None:
        """Write a JSON file; tensors and arrays become lists, numbers that are not finite null."""
        text = json.dumps(plain(value), indent=2, ensure_ascii=False, allow_nan=False)
        self.write_text(name, text + "\n")

    def read_json(self, name: str) -> Any | None:
        """A JSON file that this run wrote before it was interrupted, or None."""
        path = self.path / name
        if name not in self._manifest["files"] or not path.exists():
            return None
        return json.loads(path.read_text(encoding="utf-8"))

    def remove(self, names: Iterable[str]) -> None:
        """Remove intermediate files of this run."""
        names = list(names)
        self._manifest["files"] = [f for f in self._manifest["files"] if f not in names]
        self._save_manifest()
        _remove(self.path, names)

    def _save_manifest(self) -> None:
        _replace(self.path / MANIFEST, json.dumps(self._manifest, indent=1).encode())

    def _undo(self) -> None:
        _remove(self.path, [*self._manifest["files"], MANIFEST])
        previous = self.path / PREVIOUS
        if previous.exists():
            _move(previous, self.path, _files_under(previous))
            shutil.rmtree(previous)
        for made in [self.path, *self.path.parents][: self._manifest["created"]]:
            if any(made.iterdir()):
                return
            made.rmdir()


def open_run(
    path: Path, runs: Mapping[str, Any], *, overwrite: bool = False, resume: bool = False
) -> RunFolder:
    """Take a folder for a run and write the run files as used into it.

    Args:
        path: The folder; made with its parents when it does not exist.
        runs: Run files as used, by file stem; one is written as run.toml, several as
            runs/<stem>.toml.
        overwrite: Replace the results that are there; they are set aside until this run ends.
        resume: Go on with the interrupted run that is there.

    Raises:
        InputError: The folder holds results and neither flag is given, there is nothing to
            resume, or it belongs to another run file.
    """
    if overwrite and resume:
        raise InputError("expected --overwrite or --resume, got both; choose one")
    if path.exists() and not path.is_dir():
        raise InputError(
            f"expected a folder for the results, got the file {path}; choose another -o"
        )
    texts = {name: to_toml(run) for name, run in runs.items()}
    digest = hashlib.sha256(json.dumps(texts, sort_keys=True).encode()).hexdigest()
    manifest = _read_manifest(path)
    if resume:
        return RunFolder(path, _to_resume(path, manifest, digest), resumed=True)
    found = manifest["files"] if manifest else RESULTS
    found = [name for name in found if (path / name).exists()]
    if found and not overwrite:
        raise InputError(
            f"expected a folder without results, got {path} with {found[0]} in it; "
            "add --overwrite or choose another -o (interrupted fits go on with --resume)"
        )
    created = sum(not folder.exists() for folder in (path, *path.parents))
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"expected a folder that can be made, got {path}: {error.strerror}; choose another -o"
        ) from None
    _set_aside(path, found, manifest)
    new = {"files": [], "digest": digest, "complete": False, "created": created}
    folder = RunFolder(path, new, resumed=False)
    for name, text in texts.items():
        folder.write_text("run.toml" if len(texts) == 1 else f"runs/{name}.toml", text)
    return folder


def _to_resume(path: Path, manifest: dict[str, Any] | None, digest: str) -> dict[str, Any]:
    if manifest is None:
        raise InputError(
            f"expected a folder with an interrupted run, got {path} without one; "
            "leave --resume out or correct -o"
        )
    if manifest["digest"] != digest:
        raise InputError(
            f"expected the run file and options that {path} was made with (its run.toml), got "
            "others; use those, or --overwrite"
        )
    return manifest


def _read_manifest(path: Path) -> dict[str, Any] | None:
    try:
        return json.loads((path / MANIFEST).read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (json.JSONDecodeError, UnicodeDecodeError):
        raise InputError(
            f"expected a readable {MANIFEST}, got a damaged one in {path}; choose another -o"
        ) from None


def _set_aside(path: Path, names: list[str], manifest: dict[str, Any] | None) -> None:
    previous = path / PREVIOUS
    if previous.exists():
        # An earlier --overwrite was interrupted: what it had set aside is the result to keep.
        _remove(path, names)
    elif names:
        _move(path, previous, [*names, MANIFEST] if manifest else names)


def _files_under(folder: Path) -> list[str]:
    return [str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()]


def _move(source: Path, target: Path, names: Iterable[str]) -> None:
    for name in names:
        if (source / name).exists():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(source / name, target / name)
            _remove_empty_parents(source, name)


def _remove(folder: Path, names: Iterable[str]) -> None:
    for name in names:
        (folder / name).unlink(missing_ok=True)
        _remove_empty_parents(folder, name)


def _remove_empty_parents(folder: Path, name: str) -> None:
    for parent in list((folder / name).parents):
        if parent == folder or not parent.exists() or any(parent.iterdir()):
            return
        parent.rmdir()


def _replace(path: Path, data: bytes) -> None:
    draft = path.with_name(path.name + ".part")
    draft.write_bytes(data)
    os.replace(draft, path)


def plain(value: Any) -> Any:
    """A value as JSON can hold it: tensors and arrays as lists, non-finite numbers as None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    return str(value)
