"""Convert a radar to labelled arrays and attributes, and back.

Captures on disk are NetCDF in HDF5, written in one step.
"""

from collections.abc import Hashable, Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import torch
import xarray as xr
from torch import Tensor

from invertwin.checks import check_choice, check_shape
from invertwin.constants import OLD_AXES
from invertwin.errors import InputError
from invertwin.radar.radar import Radar
from invertwin.radar.waveform import FMCW, OFDM, Impulse, SteppedFrequency, Waveform
from invertwin.refusals import refusal
from invertwin.scene.antenna import AntennaArray, Cosine, Isotropic, Pattern, TabulatedPattern
from invertwin.scene.polarisation import JonesTable, Polarisation
from invertwin.storage.folders import replace_file
from invertwin.storage.isolated_reader import read_isolated
from invertwin.storage.untrusted import convert_read_errors, existing_file

WAVEFORMS: dict[str, type[Waveform]] = {
    kind.__name__: kind for kind in (FMCW, Impulse, SteppedFrequency, OFDM)
}
"""Dataclasses that a file may name. Add one of your own to keep what it has measured."""

_AXES = "x forward, y left, z up"
_VISIBILITY = {None: "auto", True: "shared", False: "separate"}


def radar_fields(radar: Radar) -> tuple[dict[str, xr.DataArray], dict[str, Any]]:
    """Variables and attributes that describe a radar; gradients are dropped.

    Raises:
        InputError: a waveform or pattern of one's own, which a file cannot hold.
    """
    waveform = radar.waveform
    kind = type(waveform).__name__
    if kind not in WAVEFORMS or not isinstance(waveform, tuple(WAVEFORMS.values())):
        raise InputError(f"expected a waveform of {', '.join(WAVEFORMS)}, got {kind}; use those")
    variables = {"position": to_data_array(("frame", "axis"), radar.positions, "m")}
    axes = ("frame", "axis", "radar_axis")
    variables["rotation"] = to_data_array(axes, radar.link().rotations, "1")
    if radar.range_origin is not None:
        variables["range_origin"] = to_data_array(("frame",), radar.range_origin, "m")
    attributes: dict[str, Any] = {
        "axes": _AXES,
        "waveform": kind,
        **asdict(waveform),  # type: ignore[call-overload]
        "window": radar.window,
        "array_window": radar.array_window,
        "visibility": _VISIBILITY[radar.shared_visibility],
    }
    for end, array in (("tx", radar.transmitters), ("rx", radar.receivers)):
        variables[f"{end}_position"] = to_data_array((end, "radar_axis"), array.positions, "m")
        arrays, named = _pattern_fields(end, array.pattern)
        variables |= arrays | _jones_fields(end, array.jones)
        attributes |= named
    return variables, attributes


def radar_from_fields(dataset: xr.Dataset) -> Radar:
    """The radar that `radar_fields` described.

    Raises:
        InputError: a missing or unknown attribute or variable.
    """
    _get_choice(dataset.attrs, "axes", {_AXES: None})
    visibility = {name: shared for shared, name in _VISIBILITY.items()}
    return Radar(
        transmitters=_array_from_fields("tx", dataset),
        receivers=_array_from_fields("rx", dataset),
        waveform=_waveform(dataset.attrs),
        positions=read_tensor(dataset, "position"),
        rotations=read_tensor(dataset, "rotation"),
        window=str(_get_entry(dataset.attrs, "window")),
        array_window=str(_get_entry(dataset.attrs, "array_window")),
        shared_visibility=_get_choice(dataset.attrs, "visibility", visibility),
        range_origin=read_tensor(dataset, "range_origin") if "range_origin" in dataset else None,
    )


def convert_old_axes(dataset: xr.Dataset) -> xr.Dataset:
    """The dataset with x forward, y left, z up: positions become P p, rotations P R Pᵀ.

    Args:
        dataset: dataset of a file; one that states its axes stays as it is.
    """
    if "axes" in dataset.attrs:
        return dataset
    orders = {dim: list(OLD_AXES) for dim in ("axis", "radar_axis") if dim in dataset.dims}
    return dataset.isel(orders).assign_attrs(axes=_AXES)


def _waveform(attributes: Mapping[Hashable, Any]) -> Waveform:
    """The waveform named by the attribute ``waveform``, with its fields."""
    kind = _get_choice(attributes, "waveform", WAVEFORMS)
    # Numbers come back from a file as NumPy scalars.
    types = get_type_hints(kind)  # without the limits that annotations may have
    values = {
        field.name: (int if types[field.name] is int else float)(_get_entry(attributes, field.name))
        for field in fields(kind)
    }
    return kind(**values)  # pyright: ignore[reportArgumentType]


def to_data_array(dims: tuple[str, ...], value: Tensor, unit: str) -> xr.DataArray:
    """A copy of a tensor with named dimensions and a unit.

    Args:
        dims: name of each dimension.
        value: the tensor.
        unit: such as "m".

    Raises:
        InputError: another number of dimensions.
    """
    what, do = f"dimensions {', '.join(dims)}", "give one size for each of them"
    check_shape(value, [None] * len(dims), what, do)
    values = value.detach().cpu().resolve_conj().numpy().copy()
    return xr.DataArray(values, dims=dims, attrs={"units": unit})


def read_tensor(dataset: xr.Dataset, name: str) -> Tensor:
    """A copy of a variable as a tensor.

    Args:
        dataset: dataset of a capture.
        name: name of the variable.

    Raises:
        InputError: the variable is missing.
    """
    return torch.from_numpy(np.array(_get_entry(dataset.variables, name, "a variable").values))


def _get_entry(entries: Mapping[Any, Any], name: str, what: str = "an attribute") -> Any:
    if name not in entries:
        raise refusal("radar_fields.entry", what, name)
    return entries[name]


def _get_choice(attributes: Mapping[Hashable, Any], name: str, choices: Mapping[str, Any]) -> Any:
    value = _get_entry(attributes, name)
    do = "the capture was written by another version or program"
    check_choice(value, choices, f"{name} to be one of", do)
    return choices[value]


def _pattern_fields(end: str, pattern: Pattern) -> tuple[dict[str, xr.DataArray], dict[str, Any]]:
    name = f"{end}_pattern"
    if isinstance(pattern, Isotropic):
        return {}, {name: "isotropic"}
    if isinstance(pattern, Cosine):
        return {}, {name: "cosine", f"{name}_exponent": float(pattern.exponent)}
    if isinstance(pattern, TabulatedPattern):
        theta, phi = f"{end}_theta", f"{end}_phi"
        return {
            theta: to_data_array((theta,), pattern.theta, "rad"),
            phi: to_data_array((phi,), pattern.phi, "rad"),
            f"{end}_gain": to_data_array((theta, phi), pattern.gains, "1"),
        }, {name: "table"}
    raise refusal("radar_fields.pattern", type(pattern).__name__)


def _array_from_fields(end: str, dataset: xr.Dataset) -> AntennaArray:
    patterns = {
        "isotropic": Isotropic,
        "cosine": lambda: Cosine(float(_get_entry(dataset.attrs, f"{end}_pattern_exponent"))),
        "table": lambda: TabulatedPattern(
            *(read_tensor(dataset, f"{end}_{k}") for k in ("theta", "phi", "gain"))
        ),
    }
    pattern = _get_choice(dataset.attrs, f"{end}_pattern", patterns)()
    array = AntennaArray(read_tensor(dataset, f"{end}_position"), pattern)
    if f"{end}_jones" in dataset.variables:
        return replace(array, polarisation=_read_complex(dataset, f"{end}_jones"))
    if f"{end}_jones_table" not in dataset.variables:
        return array
    theta, phi = (read_tensor(dataset, f"{end}_jones_{name}") for name in ("theta", "phi"))
    table = JonesTable(theta, phi, _read_complex(dataset, f"{end}_jones_table"))
    mixtures = _read_complex(dataset, f"{end}_mixture")
    return replace(array, polarisation=table, leakage=mixtures[:, 1] / mixtures[:, 0])


def _jones_fields(end: str, jones: Polarisation) -> dict[str, xr.DataArray]:
    """Polarisations; none where all elements are V, as in files of earlier versions."""

    def complex_array(dims: tuple[str, ...], value: Tensor) -> xr.DataArray:
        return to_data_array((*dims, "polarisation", "part"), torch.view_as_real(value), "1")

    if not isinstance(jones.base, JonesTable):
        vectors = jones.vectors.resolve_conj()
        plain = bool((vectors == torch.tensor([1.0, 0.0])).all())
        return {} if plain else {f"{end}_jones": complex_array((end,), vectors)}
    theta, phi = f"{end}_jones_theta", f"{end}_jones_phi"
    mixtures = torch.nn.functional.pad(jones.mixtures, (0, 2 - jones.mixtures.shape[1]))
    return {
        theta: to_data_array((theta,), jones.base.theta, "rad"),
        phi: to_data_array((phi,), jones.base.phi, "rad"),
        f"{end}_jones_table": complex_array((theta, phi), jones.base.vectors),
        f"{end}_mixture": complex_array((end,), mixtures),
    }


def _read_complex(dataset: xr.Dataset, name: str) -> Tensor:
    return torch.view_as_complex(read_tensor(dataset, name).contiguous())


def write_dataset(dataset: xr.Dataset, path: Path) -> None:
    """Write a dataset, complex variables as two real ones. The file is complete or not there.

    Args:
        dataset: data set to write.
        path: file; an old one is replaced.

    Raises:
        InputError: the folder does not exist.
    """
    with replace_file(path) as part:
        real = _split_complex(dataset)
        # No fill values: they would mark numbers as missing.
        encoding = {str(variable): {"_FillValue": None} for variable in real.variables}
        # In memory first: on a full disk libhdf5 fails again, and crashes, at the end.
        part.write_bytes(real.to_netcdf(engine="h5netcdf", encoding=encoding))


def read_dataset(path: Path, *, trusted: bool = False) -> xr.Dataset:
    """Read what `write_dataset` wrote.

    Args:
        path: file.
        trusted: read it in this process, not in a child process.

    Raises:
        InputError: no such file, or one that is damaged or no NetCDF.
    """
    existing_file(path, "a capture file")
    with convert_read_errors(path, "a whole NetCDF file"):
        stored = read_isolated(path, "netcdf", trusted=trusted)
        return _join_complex(xr.Dataset(stored.arrays, attrs=stored.attributes))


def _split_complex(dataset: xr.Dataset) -> xr.Dataset:
    for name, whole in dataset.data_vars.items():
        if whole.dtype.kind == "c":
            parts = {f"{name}_real": whole.real, f"{name}_imag": whole.imag}
            parts = {key: part.assign_attrs(whole.attrs) for key, part in parts.items()}
            dataset = dataset.drop_vars([name]).assign(parts)
    return dataset


def _join_complex(dataset: xr.Dataset) -> xr.Dataset:
    for name in [str(key) for key in dataset.data_vars if str(key).endswith("_real")]:
        real, whole = dataset[name], name.removesuffix("_real")
        imaginary = dataset.get(f"{whole}_imag")
        if imaginary is None or imaginary.dims != real.dims:
            raise refusal("radar_fields.imaginary_part", whole, name)
        # Part by part: real + 1j * imaginary would lose the signs of zeros.
        values = np.empty(real.shape, dtype=f"c{2 * real.dtype.itemsize}")
        values.real, values.imag = real.values, imaginary.values
        dataset = dataset.drop_vars([name, f"{whole}_imag"])
        dataset = dataset.assign({whole: (real.dims, values, real.attrs)})
    return dataset
