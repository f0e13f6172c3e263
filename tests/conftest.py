"""What every test shares: run-time shape checks, the data folder, the GPU marker."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from jaxtyping import config, install_import_hook

# Before torch, Dr.Jit and matplotlib are imported: no display, and one thread for torch, whose
# operations here are small. On a busy machine two threads that wait for each other cost eightfold.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

# Shape annotations are executed in tests only; users pay nothing for them. The numeric tower of
# PEP 484: an int is welcome where a float is asked for.
install_import_hook(
    ["invertwin", "invertwin_studies"],
    "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))",
)

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the checkout."""
    return REPOSITORY


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """Measured data: `$INVERTWIN_DATA`, by default `../shared/data` beside the checkout."""
    default = REPOSITORY.parent / "shared" / "data"
    folder = Path(os.environ.get("INVERTWIN_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no measured data in {folder}: set INVERTWIN_DATA")
    return folder


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Bad input as users meet it: the shape checks of the tests would catch it first."""
    config.update("jaxtyping_disable", True)
    yield
    config.update("jaxtyping_disable", False)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    marked = [item for item in items if item.get_closest_marker("gpu")]
    if not marked:
        return
    from invertwin import doctor

    if doctor.gpu_name() is None:
        for item in marked:
            item.add_marker(pytest.mark.skip(reason="no NVIDIA GPU on this machine"))
