"""Fits by other processes are those that this one makes, and are made once."""

from typing import Any

import pytest

from cli.small import RUN, STARTS, call, read_metrics
from cli.test_radio import RUN as RADIO
from cli.test_radio import STARTS as RADIO_STARTS
from invertwin.cli.commands import reconstruct as run_reconstruct
from invertwin.cli.fits import spreading
from invertwin.cli.fits.spreading import fit_file_stem
from invertwin.storage.folders import PARTS

SHORT = RUN.replace("steps = 8", "steps = 3")
VARIANT = "\n[variants.fixed]\nreconstruct = { boundary = false }\n"
CALIBRATED = f"{PARTS}/calibration.pt"
MANY = SHORT + STARTS + VARIANT
EVERY = SHORT.replace("snr_db = 20.0", "snr_db = 20.0\nevery_start = true") + STARTS


def compared(value: Any) -> Any:
    """Metrics without times and memory, which differ from run to run."""
    if isinstance(value, dict):
        names = [name for name in value if "seconds" not in name and name != "peak_memory_gb"]
        return {name: compared(value[name]) for name in names}
    return [compared(item) for item in value] if isinstance(value, list) else value


@pytest.fixture
def here(monkeypatch):
    """Work that is given away is done in this process; the fixture lists it."""
    jobs = []

    def done_here(work, given, **_):
        for number, job in enumerate(given):
            jobs.append(job)
            yield number, work(job)

    monkeypatch.setattr(spreading, "run_jobs", done_here)
    return jobs


@pytest.mark.parametrize(
    ("text", "fits"),
    [
        (MANY, [("full", 0), ("full", 1), ("fixed", 0), ("fixed", 1)]),
        pytest.param(EVERY, [("full", 0), ("full", 1)], marks=pytest.mark.slow),
        pytest.param(
            RADIO + RADIO_STARTS,
            [(mode, k) for mode in ("full", "bare") for k in (0, 1)],
            marks=pytest.mark.slow,
        ),
    ],
    ids=["variants", "a recording for every start", "received levels"],
)
def test_what_workers_fit_is_not_fitted_again(run_file, monkeypatch, here, text, fits):
    run_file.write_text(text)
    assert call(monkeypatch, "reconstruct", run_file, "-o", "whole") == 0
    assert here == []
    assert call(monkeypatch, "reconstruct", run_file, "-o", "apart", "--workers", "2") == 0
    assert here == fits
    whole, apart = (read_metrics(run_file.parent / name) for name in ("whole", "apart"))
    assert compared(apart) == approximately(compared(whole))


def approximately(value: Any) -> Any:
    """Numbers to 1e-6: sums of the ray kernel run in an order that changes."""
    if isinstance(value, dict):
        return {name: approximately(item) for name, item in value.items()}
    if isinstance(value, list):
        return [approximately(item) for item in value]
    return pytest.approx(value, rel=1e-6, abs=1e-9) if isinstance(value, float) else value


def test_fits_that_are_in_the_folder_are_left_to_it(run_file, monkeypatch, here):
    run_file.write_text(MANY)

    def broken(run, mode, number, folder):
        if mode == "fixed":
            raise KeyboardInterrupt
        run_reconstruct._fit_one(run, mode, number, folder)

    whole = spreading.distribute_fits
    monkeypatch.setattr(run_reconstruct, "distribute_fits", lambda _, *given: whole(broken, *given))
    command = ("reconstruct", run_file, "-o", "cut", "--workers", "2")
    assert call(monkeypatch, *command) == 130
    assert here == [("full", 0), ("full", 1), ("fixed", 0)]
    monkeypatch.setattr(run_reconstruct, "distribute_fits", whole)
    here.clear()
    assert call(monkeypatch, *command, "--resume") == 0
    assert here == [("fixed", 0), ("fixed", 1)]


def goes_on(run, mode, start, folder):
    """A fit that makes something of the calibration."""
    begun = folder.file(CALIBRATED).read_bytes()
    folder.write_bytes(f"{fit_file_stem(mode, start)}.json", begun + str(run.seed).encode())


def test_a_worker_goes_on_from_the_calibration():
    made = spreading.run_fit_job(goes_on, SHORT, {CALIBRATED: b"seed "}, ("full", 1))
    assert made == {f"{PARTS}/full_01.json": b"seed 3"}


@pytest.mark.parametrize("options", [("--workers", "2"), ("--engine", "ray")])
def test_one_fit_is_refused(run_file, monkeypatch, capsys, options):
    run_file.write_text(SHORT)
    assert call(monkeypatch, "reconstruct", run_file, *options) == 2
    assert "expected several starts or variants for --engine" in capsys.readouterr().err
    assert not (run_file.parent / "out").exists()


@pytest.mark.slow
def test_processes_make_the_same_fits(run_file, monkeypatch):
    run_file.write_text(SHORT + STARTS)
    assert call(monkeypatch, "reconstruct", run_file, "-o", "whole") == 0
    assert call(monkeypatch, "reconstruct", run_file, "-o", "apart", "--workers", "2") == 0
    whole, apart = (read_metrics(run_file.parent / name) for name in ("whole", "apart"))
    assert compared(apart) == approximately(compared(whole))


@pytest.mark.slow
def test_two_nodes_of_a_ray_cluster_make_the_same_fits(run_file, monkeypatch):
    """Runs where the extra `ray` is installed."""
    ray = pytest.importorskip("ray")
    monkeypatch.setenv("OMP_NUM_THREADS", "2")  # what nodes inherit, and workers must not
    from ray.cluster_utils import Cluster  # pyright: ignore[reportMissingImports]

    run_file.write_text(MANY)
    assert call(monkeypatch, "reconstruct", run_file, "-o", "whole", "--workers", "2") == 0
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        cluster.add_node(num_cpus=1)
        ray.init(address=cluster.address, log_to_driver=False)
        assert call(monkeypatch, "reconstruct", run_file, "-o", "ray", "--engine", "ray") == 0
    finally:
        ray.shutdown()
        cluster.shutdown()
    whole, apart = (compared(read_metrics(run_file.parent / name)) for name in ("whole", "ray"))
    # The fits are the same, bit for bit: their workers have one thread each.
    assert apart["starts"] == whole["starts"]
    assert apart["starts_fixed"] == whole["starts_fixed"]
