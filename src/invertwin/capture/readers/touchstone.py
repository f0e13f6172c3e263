"""Measured signatures: tables of radar cross-sections, and Touchstone files of analysers."""

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from invertwin.errors import InputError
from invertwin.storage.untrusted import convert_read_errors, read_text

_UNITS = {"HZ": 1.0, "KHZ": 1e3, "MHZ": 1e6, "GHZ": 1e9}
_FORMATS = ("MA", "DB", "RI")
_PORTS = re.compile(r"\.(?:s(\d+)p|ts)", re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class MeasuredRcs:
    """A radar cross-section over aspect, one row a value.

    Attributes:
        frequency: [Hz].
        theta, phi: direction to the radar [rad].
        dbsm: σ over 1 m², in decibels.
    """

    frequency: Float64[Tensor, " row"]
    theta: Float64[Tensor, " row"]
    phi: Float64[Tensor, " row"]
    dbsm: Float64[Tensor, " row"]


@dataclass(frozen=True, eq=False)
class Touchstone:
    """Scattering parameters of a network analyser.

    Attributes:
        frequencies: [Hz], ascending.
        parameters: S of every frequency, [frequency, port out, port in].
        resistance: reference resistance [Ω], of the first port where they differ.
    """

    frequencies: Float64[Tensor, " frequency"]
    parameters: Complex128[Tensor, "frequency port port"]
    resistance: float


def load_rcs(file: str | Path) -> MeasuredRcs:
    """Read a text file of rows of frequency [Hz], θ [°], φ [°] and RCS [dBsm].

    Args:
        file: as the Austin RCS Benchmark Suite has them.

    Raises:
        InputError: no such file, other columns, or numbers that are not finite.
    """
    what = "rows of frequency, theta, phi and RCS"
    text = read_text(file, what)
    with convert_read_errors(file, what):
        rows = np.array([[float(cell) for cell in line.split()] for line in text.splitlines()])
        if rows.ndim != 2 or rows.shape[1] != 4 or not np.isfinite(rows).all():
            raise ValueError("other than four finite numbers a row")
    frequency, theta, phi, level = torch.from_numpy(rows.T.copy())
    return MeasuredRcs(frequency, theta.deg2rad(), phi.deg2rad(), level)


def load_touchstone(file: str | Path) -> Touchstone:
    """Read a Touchstone file (.s1p, .s2p, .ts and so on), version 1 or 2; noise data are left out.

    Args:
        file: its suffix tells the number of ports, for ``.ts`` its keyword.

    Raises:
        InputError: no such file, another suffix, parameters other than S, a mixed-mode order, or a
            damaged file.
    """
    path = Path(file)
    ports = _PORTS.fullmatch(path.suffix)
    if ports is None or int(ports[1] or 1) not in range(1, 100):
        raise InputError(f"expected a Touchstone file such as .s1p or .s2p, got {path.name}")
    what = f"a Touchstone file of {ports[1]} ports" if ports[1] else "a Touchstone file"
    text = read_text(path, what)
    with convert_read_errors(path, what, "export it again, with points as decimal marks"):
        lines = [line.split("!")[0].strip() for line in text.splitlines()]
        options = next((line[1:].upper().split() for line in lines if line.startswith("#")), [])
        unit, kind, resistance = _parse_option_line(options)
        keywords = _split_keywords(lines)
        if "version" in keywords:
            count, values = _read_version_2(keywords)
            resistance = float((keywords.get("reference") or [resistance])[0])
        else:
            count, values = int(ports[1]), _read_version_1(lines, int(ports[1]))
        if int(ports[1] or count) != count:
            raise ValueError(f"{count} ports in its keyword")
        if not len(values) or not np.isfinite(values).all():
            raise ValueError("no finite numbers")
        matrix = _to_complex(values[:, 1::2], values[:, 2::2], kind)
    # Two ports are listed as S11, S21, S12, S22; others row by row.
    if count == 2 and keywords.get("two-port data order") != ["12_21"] and matrix.shape[1] == 4:
        matrix = matrix[:, [0, 2, 1, 3]]
    values, matrix = (part[np.argsort(values[:, 0], kind="stable")] for part in (values, matrix))
    filled = _fill_matrix(matrix, count, keywords.get("matrix format", ["full"])[0].lower())
    return Touchstone(torch.from_numpy(values[:, 0] * unit), torch.from_numpy(filled), resistance)


def _split_keywords(lines: list[str]) -> dict[str, list[str]]:
    """Words after each keyword of version 2, on its line or on those that follow."""
    words: dict[str, list[str]] = {}
    keyword = ""
    for line in lines:
        if line.startswith("["):
            keyword, line = line[1:].lower().split("]", 1)
            words.setdefault(keyword, [])
        if not line.startswith("#"):
            words.setdefault(keyword, []).extend(line.split())
    return words


def _read_version_1(lines: list[str], count: int) -> np.ndarray:
    """Rows of frequency and pairs of numbers."""
    numbers = [float(word) for line in lines if line[:1] not in "#[" for word in line.split()]
    width = 1 + 2 * count**2
    if len(numbers) % width and count != 2:
        raise ValueError(f"{len(numbers)} numbers, no multiple of {width}")
    rows = np.array(numbers[: len(numbers) // width * width]).reshape(-1, width)
    # Noise data of two ports follow; their frequencies begin anew.
    way = np.diff(rows[:, 0]) * np.diff(rows[:2, 0])
    falls = np.nonzero(way <= 0 if len(numbers) % width else way < 0)[0]
    return rows[: falls[0] + 1] if len(falls) and count == 2 else rows


def _read_version_2(keywords: dict[str, list[str]]) -> tuple[int, np.ndarray]:
    """Number of ports, and rows of frequency and pairs of numbers; noise has its own keyword."""
    if "mixed-mode order" in keywords:
        raise ValueError("parameters of mixed modes; export those of single ports")
    count, stated = (int(keywords[f"number of {name}"][0]) for name in ("ports", "frequencies"))
    whole = keywords.get("matrix format", ["full"])[0].lower() == "full"
    rows = np.array([float(word) for word in keywords["network data"]])
    width = 1 + 2 * (count**2 if whole else count * (count + 1) // 2)
    if len(rows) != width * stated:
        raise ValueError(f"{len(rows)} numbers, not {stated} frequencies of {width}")
    return count, rows.reshape(-1, width)


def _fill_matrix(values: np.ndarray, count: int, layout: str) -> np.ndarray:
    """Matrices [row, port, port] of values listed in full, or in one triangle of them."""
    if layout == "full":
        return values.reshape(-1, count, count)
    rows, columns = np.tril_indices(count) if layout == "lower" else np.triu_indices(count)
    filled = np.zeros((len(values), count, count), dtype=np.complex128)
    filled[:, rows, columns] = filled[:, columns, rows] = values
    return filled


def _parse_option_line(words: list[str]) -> tuple[float, str, float]:
    """Unit, format and resistance of the option line; without one GHz, MA and 50 Ω."""
    unit, kind, resistance = 1e9, "MA", 50.0
    for number, word in enumerate(words):
        if word in _UNITS:
            unit = _UNITS[word]
        elif word in _FORMATS:
            kind = word
        elif word == "R":
            resistance = float(words[number + 1])
        elif word != "S" and words[number - 1] != "R":
            raise ValueError(f"the option {word}")
    return unit, kind, resistance


def _to_complex(first: np.ndarray, second: np.ndarray, kind: str) -> np.ndarray:
    if kind == "RI":
        return first + 1j * second
    size = first if kind == "MA" else 10 ** (first / 20)
    return size * np.exp(1j * math.pi / 180 * second)
