"""Export of detected points."""

from pathlib import Path

import numpy as np

from invertwin.errors import InputError
from invertwin.radar.processing.detection import PointCloud
from invertwin.storage.folders import replace_file


def save_points(path: str | Path, points: PointCloud) -> None:
    """Write points as binary PLY or PCD, one record each, the strongest first.

    Fields are ``x``, ``y``, ``z`` in the world [m], ``range`` [m], ``velocity`` [m/s], ``u``,
    ``v``, ``power`` [dB] and ``frame``, all as float32, which all readers of either format support.

    Args:
        path: output file, ending in .ply or .pcd, in an existing folder.
        points: points to write.

    Raises:
        InputError: Another suffix, or no such folder.
    """
    file = Path(path)
    header = {".ply": _ply_header, ".pcd": _pcd_header}.get(file.suffix.lower())
    if header is None:
        raise InputError(
            f"expected a file name ending in .ply or .pcd, got {file.name}; rename the output"
        )
    columns = dict(zip("xyz", points.position.detach().cpu().numpy().T, strict=True))
    for name in ("range", "velocity", "u", "v", "power", "frame"):
        columns[name] = getattr(points, name).detach().cpu().numpy()
    order = np.argsort(-columns["power"], kind="stable")
    columns["power"] = 10 * np.log10(columns["power"])
    table = np.stack([values[order] for values in columns.values()], axis=1).astype("<f4")
    with replace_file(file) as part:
        part.write_bytes(header(list(columns), len(table)).encode("ascii") + table.tobytes())


def _ply_header(fields: list[str], count: int) -> str:
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    return "\n".join([*lines, *(f"property float {name}" for name in fields), "end_header\n"])


def _pcd_header(fields: list[str], count: int) -> str:
    lines = ["VERSION 0.7", " ".join(["FIELDS", *fields])]
    for word, value in (("SIZE", "4"), ("TYPE", "F"), ("COUNT", "1")):
        lines.append(" ".join([word, *[value] * len(fields)]))
    lines += [f"WIDTH {count}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {count}"]
    return "\n".join([*lines, "DATA binary\n"])
