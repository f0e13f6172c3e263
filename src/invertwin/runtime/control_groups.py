"""Control groups of Linux, of which containers are made."""

from collections.abc import Iterator
from pathlib import Path

_GROUPS = Path("/sys/fs/cgroup")


def group_folders(
    controller: str, listing: Path = Path("/proc/self/cgroup"), root: Path = _GROUPS
) -> Iterator[tuple[Path, int]]:
    """Yield the folders of this process's control groups, with the version of the hierarchy.

    Args:
        controller: "cpu" or "memory".
        listing: file that names the groups of the process.
        root: folder of the hierarchies.
    """
    for line in read_text(listing).splitlines():
        _, kinds, name = line.split(":", 2)
        if kinds and controller not in kinds.split(","):
            continue
        inside = (root / kinds if kinds else root) / name.lstrip("/")
        # A container has its own group as the root, under any name outside.
        for folder in (inside, *inside.parents, root / controller, root):
            if folder == root or root in folder.parents:
                yield folder, 1 if kinds else 2


def read_text(file: Path) -> str:
    """Return the text of a file; empty where there is none."""
    try:
        return file.read_text()
    except OSError:
        return ""
