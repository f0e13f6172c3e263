"""Files and boards that a command needs, checked before anything that computes is imported."""

from collections.abc import Iterable, Iterator
from pathlib import Path

from invertwin.cli.options import RecordingOptions
from invertwin.constants import read_table
from invertwin.errors import InputError
from invertwin.refusals import refusal, refusal_text
from invertwin.registry.kinds import load_plugins
from invertwin.storage.untrusted import existing_file

DATASET_SECTIONS = ("dataset", "radar", "grid", "data")
"""Sections of a run file that a data set cannot do without."""
_VIEWED = ("run.toml", "twin.toml", "capture.nc")  # of a folder, the first that is there


def require_files(files: Iterable[tuple[Path, str]], faults: Iterable[str] = ()) -> None:
    """Raise one error for all files that are missing and for all other faults.

    Args:
        files: Paths, and what each should be.
        faults: Further faults, as errors state them.
    """
    found = []
    for file, what in files:
        try:
            existing_file(file, what)
        except InputError as error:
            found.append(str(error))
    if found := [*found, *faults]:
        raise InputError(" — also ".join(found))


def require_recording(options: RecordingOptions) -> None:
    """Raise one error for all that `invertwin look` or `twin` lacks: files, settings, the board.

    Args:
        options: Options of the user.
    """
    path = options.recording
    if path.is_dir() or (path.exists() and path.suffix.lower() == ".npz"):
        find_plugin_recording(path)
    named = {"a recording": None if path.is_dir() else path, "settings": options.config}
    named["a channel calibration"] = getattr(options, "channels", None)
    files = [(file, what) for what, file in named.items() if file is not None]
    require_files(files, _recording_faults(options))


def find_plugin_recording(path: Path) -> tuple[Path, str, str | None]:
    """Folder, kind and board of a recording that a plugin reads.

    Args:
        path: The folder, or the file in it that tells the kind.

    Raises:
        InputError: There is none.
    """
    folder, known = path if path.is_dir() else path.parent, load_plugins().recordings
    for file, (kind, board) in known.items():
        if (folder / file).is_file() and path.name in (file, folder.name):
            return folder, kind, board
    raise refusal("inputs.folder", " or ".join(known) or "a recording that a plugin reads", path)


def _recording_faults(options: RecordingOptions) -> Iterator[str]:
    name, ending = options.board, options.recording.suffix.lower()
    boards, raw = read_table("invertwin", "radar/boards.toml"), ending in (".bin", ".json")
    if ending == ".bin" and options.config is None:
        yield "expected --config, got none; name the .cfg or .mmwave.json that it was set up with"
    if name not in boards and (raw or name is not None):
        yield refusal_text("inputs.unknown_board", ", ".join(boards), name or "none")
    elif name is not None and raw and options.elevation is None:
        ends = (boards[name]["transmitters"], boards[name]["receivers"])
        if any(len({row for _, row in end}) > 1 for end in ends):
            yield refusal_text("inputs.no_elevation", name)


def find_viewed_file(target: Path) -> Path:
    """The run file or the capture that `invertwin view` shows.

    Args:
        target: It, or a folder with one.

    Raises:
        InputError: The target is none of these.
    """
    if target.is_dir():
        for name in _VIEWED:
            if (target / name).is_file():
                return target / name
        raise refusal("inputs.empty_folder", ", ".join(_VIEWED), target)
    if target.suffix not in (".toml", ".nc"):
        raise refusal("inputs.other_file", target)
    return existing_file(target, "a run file or a capture")
