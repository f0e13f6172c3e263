"""Captures on disk: NetCDF in HDF5, written in one step."""

from pathlib import Path

import numpy as np
import xarray as xr

from invertwin.errors import InputError
from invertwin.storage.folders import replace_file
from invertwin.storage.isolated_reader import read_isolated
from invertwin.storage.untrusted import convert_read_errors, existing_file


def write_dataset(dataset: xr.Dataset, path: Path) -> None:
    """Write a dataset, complex variables as two real ones. The file is complete or not there.

    Args:
        dataset: what to write.
        path: file; an old one is replaced.

    Raises:
        InputError: the folder does not exist.
    """
    with replace_file(path) as part:
        real = _split_complex(dataset)
        # No fill values: they would mark numbers as missing.
        encoding = {str(variable): {"_FillValue": None} for variable in real.variables}
        real.to_netcdf(part, engine="h5netcdf", encoding=encoding)


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
            raise InputError(
                f"expected {whole}_imag beside {name} with the same shape, got none; "
                "the file is incomplete, copy or record it again"
            )
        # Part by part: real + 1j * imaginary would lose the signs of zeros.
        values = np.empty(real.shape, dtype=f"c{2 * real.dtype.itemsize}")
        values.real, values.imag = real.values, imaginary.values
        dataset = dataset.drop_vars([name, f"{whole}_imag"])
        dataset = dataset.assign({whole: (real.dims, values, real.attrs)})
    return dataset
