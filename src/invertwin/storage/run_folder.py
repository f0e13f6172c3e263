"""Run folders: what a run leaves on disk, and the rule that no result is ever lost."""

import hashlib
import json
import os
import platform
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from fnmatch import fnmatchcase
from glob import escape
from pathlib import Path
from typing import Any

from pydantic_core import to_jsonable_python

from invertwin.errors import InputError
from invertwin.storage import folders

CHECKPOINT = "checkpoint.pt"
# What commands write, beside run files and the pictures that are named after them.
RESULTS = (
    *("metrics.json", "report.html", "checkpoint*.pt", "twin.*", "raw", "capture.nc", "chirps.*"),
    *("manifest.json", "shard-*.tar", "view.npz"),
    *("channels.json", "points.*", "prior.npz", "train.log", "turntable.gif", folders.UNFINISHED),
    *("scene.png", "spectra*.png", "doppler.png", "loss*.png", "convergence.png", "landscape.png"),
    *("look.png", "micro_doppler.png", "recording.png", "twin_*.png", "residuals*.png"),
)


class RunFolder:
    """The folder of one run, from `open_run`; use it as a context manager.

    Leaving the block normally completes the run, in place of what was there before. Any other end
    keeps what can be resumed, or leaves no trace. An OSError becomes an InputError.

    Attributes:
        path: Final folder of the results.
        complete: Whether the run had ended before it was opened again.

    Args:
        path: Path of the folder.
        manifest: Content of the manifest.
        stack: Its lock.
    """

    def __init__(self, path: Path, manifest: folders.Manifest, stack: ExitStack):
        self.path, self.complete = path, manifest.unfinished is None
        self._manifest, self._held = manifest, stack

    def __enter__(self) -> "RunFolder":
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        more = "; then --resume goes on" if self.resumable else ""
        with folders.convert_os_errors(more), self._held:
            try:
                if error is None and not self.complete:
                    self._finish()
            finally:
                work = self._manifest.unfinished
                if work is not None and not work.complete and not self.resumable:
                    folders.remove_unfinished(self.path, self._manifest)
            if isinstance(error, OSError):
                raise error

    @property
    def resumable(self) -> bool:
        """Return True if this run left a state to resume from."""
        return _resumable(self.path, self._manifest)

    @property
    def run_files(self) -> dict[str, str]:
        """The run files as used, by their path in the folder."""
        names = self._manifest.unfinished.files if self._manifest.unfinished else []
        found = [name for name in names if name == "run.toml" or name.startswith("runs/")]
        return {name: self.file(name).read_text(encoding="utf-8") for name in found}

    def file(self, name: str) -> Path:
        """Return the path of a result file during the run, and own it from now on.

        Raises:
            InputError: The folder holds a file of that name that no run has written.
        """
        work = self._manifest.unfinished
        assert work is not None
        if name not in work.files:
            folders.require_free(self.path, name, self._manifest.files)
            work.files.append(name)
            folders.save_manifest(self.path, self._manifest)
        path = folders.path_in_folder(self.path, f"{folders.UNFINISHED}/{name}")
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def write_bytes(self, name: str, data: bytes) -> None:
        """Write a result file so that a kill leaves the old or the new one, never half of it.

        Args:
            name: Its path in the folder.
            data: Content of the file.
        """
        with folders.replace_file(self.file(name)) as part:
            part.write_bytes(data)

    def write_text(self, name: str, text: str) -> None:
        """Write a result file as UTF-8, in the way of `write_bytes`.

        Args:
            name: Its path in the folder.
            text: Content of the file.
        """
        self.write_bytes(name, text.encode("utf-8"))

    def write_json(self, name: str, value: Any) -> None:
        """Write a JSON file; tensors and arrays become lists, numbers that are not finite null.

        Args:
            name: Its path in the folder.
            value: Content of the file.
        """
        text = json.dumps(to_json_value(value), indent=2, ensure_ascii=False, allow_nan=False)
        self.write_text(name, text + "\n")

    def read_json(self, name: str) -> Any | None:
        """A JSON file that this run wrote before it was interrupted, or None."""
        path = self.file(name)
        return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None

    def _finish(self) -> None:
        work = self._manifest.unfinished
        assert work is not None
        # Parts stay listed, so that their folder goes even if nothing was ever written there.
        inside, parts = self.path / folders.UNFINISHED, f"{folders.PARTS}/"
        there = [one for one in work.files if one.startswith(parts) or (inside / one).exists()]
        done = work.model_copy(update={"files": there, "complete": True})
        manifest = self._manifest.model_copy(update={"unfinished": done})
        folders.save_manifest(self.path, manifest)
        self._manifest = manifest
        self._manifest = folders.move_results(self.path, manifest)


def open_run(
    path: Path, texts: Mapping[str, str], *, overwrite: bool = False, resume: bool = False
) -> RunFolder:
    """Take a folder for a run and write the run files as used into it.

    Args:
        path: The folder; made with its parents when it does not exist.
        texts: Run files as used, by file stem; one is written as run.toml, several as
            runs/<stem>.toml.
        overwrite: Replace the results that are there when this run ends.
        resume: Go on with the interrupted run that is there.

    Raises:
        InputError: The folder holds results and neither flag is given, there is nothing to
            resume, it belongs to another run file, another run uses it, it holds files of others
            where results go, or it cannot be written.
    """
    if overwrite and resume:
        raise InputError("expected --overwrite or --resume, got both; choose one")
    if "\0" in str(path):
        raise InputError(f"expected a folder's name, got {str(path)!r}; take the NUL out")
    digest = hashlib.sha256(json.dumps(texts, sort_keys=True).encode()).hexdigest()
    with folders.convert_os_errors(" or choose another -o"), ExitStack() as held:
        missing = [folder for folder in (path, *path.parents) if not folder.exists()]
        if resume and missing:
            raise _nothing_to_resume(path)
        for folder in reversed(missing):
            held.callback(folders.remove_empty, folder)
        path.mkdir(parents=True, exist_ok=True)
        folders.lock_folder(path, held)
        manifest = folders.read_manifest(path)
        if manifest.unfinished is not None and manifest.unfinished.complete:
            manifest = folders.move_results(path, manifest)
        if not resume:
            _require_free_folder(path, manifest, texts, overwrite)
            manifest = folders.remove_unfinished(path, manifest)
            manifest.unfinished = folders.UnfinishedRun(digest=digest, owner="")
        work = manifest.unfinished
        if work is None and not manifest.files:
            raise _nothing_to_resume(path)
        if digest != (manifest.digest if work is None else work.digest):
            raise InputError(
                f"expected the run file and options that {path} was made with (its run.toml), got "
                "others; use those, or --overwrite"
            )
        if work is not None:
            work.owner = f"process {os.getpid()} on {platform.node()}"
            folders.save_manifest(path, manifest)  # before there is anything that it could claim
            (path / folders.UNFINISHED).mkdir(exist_ok=resume)
        folder = RunFolder(path, manifest, held.pop_all())
    try:
        for name, text in texts.items() if work is not None else ():
            folder.write_text("run.toml" if len(texts) == 1 else f"runs/{name}.toml", text)
    except BaseException as error:
        folder.__exit__(type(error), error, None)
        raise
    return folder


def _nothing_to_resume(path: Path) -> InputError:
    return InputError(
        f"expected a folder with an interrupted run, got {path} without one; "
        "leave --resume out or correct -o"
    )


def _require_free_folder(
    path: Path, manifest: folders.Manifest, stems: Iterable[str], overwrite: bool
) -> None:
    """Refuse a folder with results that are not to be replaced, or not ours to replace."""
    found = [name for name in manifest.files if (path / name).exists()]
    if not overwrite and (found or _resumable(path, manifest)):
        what = f"{found[0]} in it" if found else "an interrupted run"
        raise InputError(
            f"expected a folder without results, got {path} with {what}; "
            "add --overwrite or choose another -o (interrupted fits go on with --resume)"
        )
    own = {name.split("/")[0]: "/" in name for name in manifest.files}  # whether it is a folder
    if manifest.unfinished is not None:
        own[folders.UNFINISHED] = True
    pictures = [f"{escape(stem)}{end}" for stem in stems for end in (".png", "_*.png")]
    wanted = (*RESULTS, *pictures, "run.toml" if len(pictures) == 2 else "runs")
    for name in sorted(os.listdir(path)):
        ours = not (path / name).is_symlink() and own.get(name) is (path / name).is_dir()
        if not ours and any(fnmatchcase(name, pattern) for pattern in wanted):
            raise folders.foreign_file_error(path, name)


def _resumable(path: Path, manifest: folders.Manifest) -> bool:
    begins, work = (f"{folders.PARTS}/", Path(CHECKPOINT).stem), manifest.unfinished
    names = [name for name in work.files if name.startswith(begins)] if work else []
    return any((path / folders.UNFINISHED / name).exists() for name in names)


def to_json_value(value: Any) -> Any:
    """A value as JSON can hold it: tensors and arrays as lists, non-finite numbers as None."""

    def convert(other: Any) -> Any:
        if isinstance(other, Mapping):
            return dict(other)
        return other.tolist() if hasattr(other, "tolist") else str(other)

    return to_jsonable_python(value, inf_nan_mode="null", fallback=convert)
