"""Folders shared with people: a manifest says what runs have written, and nothing else is touched.

A run writes into `unfinished/` inside. When it is complete, its files take their places, and those
of the run before go; until then these stay whole. A kill at any moment leaves a folder that goes
on from there. A lock keeps a second run out.
"""

import os
from collections.abc import Generator, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from glob import escape
from pathlib import Path, PurePosixPath

from filelock import FileLock, Timeout
from pydantic import BaseModel, ValidationError

from invertwin.errors import InputError
from invertwin.storage.untrusted import existing_file

MANIFEST = ".invertwin.json"
LOCK = ".invertwin.lock"
UNFINISHED = "unfinished"
PARTS = "parts"  # finished and unfinished parts of a run, until it ends


class UnfinishedRun(BaseModel):
    """A run in progress: its files in `unfinished/`, and who writes them."""

    digest: str
    owner: str
    files: list[str] = []
    complete: bool = False  # what is left to do is to move them


class Manifest(BaseModel):
    """The results in a folder, of the run with this digest, and the run in progress."""

    digest: str = ""
    files: list[str] = []
    unfinished: UnfinishedRun | None = None


@contextmanager
def replace_file(path: str | Path) -> Generator[Path]:
    """Write a new file beside a path; it takes its place when it is complete.

    A failure leaves an existing file as it was.

    Args:
        path: the file, in an existing folder; the new one has its suffix.

    Raises:
        InputError: no such folder.
    """
    file = Path(path)
    if not file.parent.is_dir():
        raise InputError(f"expected an existing folder, got {file.parent}; create it first")
    part = file.with_name(f".{file.stem}.{os.getpid()}.part{file.suffix}")
    try:
        yield part
        os.replace(part, file)
    finally:
        part.unlink(missing_ok=True)


def write_text_file(path: str | Path, text: str) -> None:
    """Write a text as UTF-8, in the way of `replace_file`.

    Args:
        path: the file, in an existing folder.
        text: its content.

    Raises:
        InputError: no such folder.
    """
    with replace_file(path) as part:
        part.write_text(text, encoding="utf-8")


@contextmanager
def convert_os_errors(do: str) -> Iterator[None]:
    """Tell what the file system refuses as an InputError, with more that one can do."""
    try:
        yield
    except OSError as error:
        raise InputError(
            "expected files that can be read and written, got "
            f"{' '.join(str(error).split())}; make room or correct names and rights{do}"
        ) from None


def foreign_file_error(path: Path, name: str) -> InputError:
    """The error of a file in the way that no run has written.

    Args:
        path: Path of the folder.
        name: Path in the folder.
    """
    return InputError(
        f"expected no file of others where results go, got {name!r} in {path}, which no run has "
        "written; move it away or choose another -o"
    )


def lock_folder(path: Path, stack: ExitStack) -> None:
    """Lock a folder until the stack is closed, or the process dies.

    Args:
        path: Path of the folder.
        stack: Keeps the lock.
    """
    file = path / LOCK
    if file.is_symlink() or (file.exists() and (not file.is_file() or file.stat().st_size)):
        raise foreign_file_error(path, LOCK)
    lock = FileLock(file, timeout=0, thread_local=False)
    try:
        lock.acquire()
    except Timeout:
        other = read_manifest(path).unfinished
        raise InputError(
            f"expected a folder that no other run uses, got {path}, in use by "
            f"{other.owner if other else 'another run'}; wait for it or choose another -o"
        ) from None
    stack.callback(lock.release)
    stack.callback(file.unlink, missing_ok=True)  # while it is held: nobody waits for it


def read_manifest(path: Path) -> Manifest:
    """The manifest of a folder, an empty one where there is none.

    Raises:
        InputError: It is damaged, or names what does not lie in the folder.
    """
    if not (path / MANIFEST).exists():
        return Manifest()
    try:
        file = existing_file(path / MANIFEST, f"a readable {MANIFEST}")
        manifest = Manifest.model_validate_json(file.read_bytes())
    except ValidationError:
        raise InputError(
            f"expected a readable {MANIFEST}, got a damaged one in {path}; choose another -o"
        ) from None
    inside = manifest.unfinished.files if manifest.unfinished else []
    for name in (*manifest.files, *(f"{UNFINISHED}/{name}" for name in inside)):
        path_in_folder(path, name)
    return manifest


def save_manifest(path: Path, manifest: Manifest) -> None:
    """Write the manifest, the old or the new one whole.

    Args:
        path: Path of the folder.
        manifest: Content of the manifest.
    """
    write_text_file(path / MANIFEST, manifest.model_dump_json(indent=1))


def path_in_folder(path: Path, name: str) -> Path:
    """A file in the folder, if its name is plain: it does not lead elsewhere, nor do links.

    Args:
        path: Path of the folder.
        name: Path in the folder.
    """
    parts = PurePosixPath(name).parts
    above = (path.joinpath(*parts[:k]) for k in range(1, len(parts)))
    outside = not parts or parts[0] == "/" or {"..", LOCK, MANIFEST} & {*parts} or "\0" in name
    if outside or not _is_possible_name(path.joinpath(*parts)):
        raise InputError(
            f"expected names of files in {path} in its {MANIFEST}, got {name[:100]!r}; "
            "choose another -o"
        )
    if any(folder.is_symlink() for folder in above):
        raise foreign_file_error(path, name)
    return path.joinpath(*parts)


def _is_possible_name(path: Path) -> bool:
    """Return True if a file of this name can exist, such as one that is not too long."""
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return True
    except (OSError, ValueError):  # too long, or letters that no name has
        return False
    return True


def require_free(path: Path, name: str, replaceable: Iterable[str]) -> None:
    """Refuse a name at which something lies that is no file of our own.

    Args:
        path: Path of the folder.
        name: Path in the folder.
        replaceable: Names of files that may be replaced.
    """
    place = path_in_folder(path, name)
    if os.path.lexists(place) and (name not in replaceable or place.is_symlink() or place.is_dir()):
        raise foreign_file_error(path, name)


def move_results(path: Path, manifest: Manifest) -> Manifest:
    """Put the files of a complete run in their places; go on where a kill has cut it short.

    Args:
        path: Path of the folder.
        manifest: Content of the manifest.
    """
    work = manifest.unfinished
    assert work is not None
    results = [name for name in work.files if not name.startswith(f"{PARTS}/")]
    waiting = [name for name in results if (path / UNFINISHED / name).exists()]
    for name in waiting:
        require_free(path, name, manifest.files)
    for name in waiting:
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(path / UNFINISHED / name, path / name)
    _remove(path, set(manifest.files).difference(results))
    return remove_unfinished(path, Manifest(digest=work.digest, files=results, unfinished=work))


def remove_unfinished(path: Path, manifest: Manifest) -> Manifest:
    """Remove what an unfinished run has left.

    Args:
        path: Path of the folder.
        manifest: Content of the manifest.
    """
    if manifest.unfinished is None:
        return manifest
    _remove(path, [f"{UNFINISHED}/{name}" for name in manifest.unfinished.files])
    remove_empty(path / UNFINISHED)
    left = manifest.model_copy(update={"unfinished": None})
    if left.files:
        save_manifest(path, left)
    else:
        (path / MANIFEST).unlink(missing_ok=True)
    return left


def _remove(path: Path, names: Iterable[str]) -> None:
    """Remove files, the drafts of them that a kill has left, and folders that are then empty."""
    for name in names:
        place = path_in_folder(path, name)
        drafts = place.parent.glob(f".{escape(place.stem)}.*.part{escape(place.suffix)}")
        for file in (place, *drafts):
            if file.is_file() and not file.is_symlink():
                file.unlink()
        for k in range(1, len(PurePosixPath(name).parts)):
            remove_empty(path.joinpath(*PurePosixPath(name).parts[:-k]))


def remove_empty(folder: Path) -> None:
    """Remove a folder if nothing is in it."""
    with suppress(OSError):
        folder.rmdir()
