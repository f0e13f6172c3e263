"""Many independent pieces of work, spread over processes of this machine or over a Ray cluster.

A piece of work is a function that another process can import, and an argument for it. Every worker
has one thread, so that a piece gives the same bits wherever and beside whatever it is done.

Processes are spawned, never forked: a fork of a process whose ray tracer has started hangs. Workers
of one machine share Dr.Jit's cache of compiled kernels (``~/.drjit``, or ``DRJIT_CACHE_DIR``).
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection
from typing import Any, Literal, NamedTuple, TypeVar

from invertwin.errors import InputError, import_optional
from invertwin.runtime import threads

Engine = Literal["processes", "ray"]
_Job = TypeVar("_Job")
_Result = TypeVar("_Result")

_QUEUED_PER_WORKER = 2  # pieces that wait for each worker, so that none is idle
# One thread each; code of the folder that they are started in does not run.
_CHILD_VARIABLES = {**dict.fromkeys(threads.COUNT_VARIABLES, "1"), "PYTHONSAFEPATH": "1"}


class _WorkerError(NamedTuple):
    """An InputError as text: not all of them can be pickled."""

    text: str


def run_jobs(
    work: Callable[[_Job], _Result],
    jobs: Sequence[_Job],
    *,
    engine: Engine = "processes",
    workers: int = 1,
) -> Generator[tuple[int, _Result]]:
    """Do pieces of work by other processes; yield number and result of each as it comes.

    Results that nobody has taken yet are few, so that they may be large. Workers end when the
    generator is closed.

    Args:
        work: A function of a module, not a lambda.
        jobs: Its arguments, one for each piece.
        engine: Processes of this machine, or tasks of the Ray cluster that ``RAY_ADDRESS`` names
            or that the program is connected to (the extra ``ray``); without one, Ray uses the
            cores of this machine.
        workers: Processes; a cluster has as many workers as cores.

    Raises:
        InputError: What a piece of work refuses, a worker that has died, an engine that is not
            known or not installed, or no workers.
    """
    if engine not in ("processes", "ray"):
        raise InputError(f"expected engine 'processes' or 'ray', got {engine!r}; choose one")
    if workers < 1:
        raise InputError(f"expected at least one worker, got {workers}; give their number")
    if not jobs:
        return
    started = _processes(min(workers, len(jobs))) if engine == "processes" else _ray_cluster()
    with started as (count, submit, ended):
        waiting: dict[Any, int] = {}
        for number, job in enumerate(jobs):
            if len(waiting) >= _QUEUED_PER_WORKER * count:
                yield from _collect_results(ended(waiting), waiting)
            waiting[submit(work, job)] = number
        while waiting:
            yield from _collect_results(ended(waiting), waiting)


def _collect_results(
    done: Sequence[tuple[Any, Any]], pending: dict[Any, int]
) -> Iterator[tuple[int, Any]]:
    for ticket, result in done:
        number = pending.pop(ticket)
        if isinstance(result, _WorkerError):
            raise InputError(result.text)
        yield number, result


def _run_guarded(work: Callable[[Any], Any], job: Any) -> Any:
    try:
        return work(job)
    except InputError as error:
        return _WorkerError(str(error))


@contextmanager
def _processes(workers: int) -> Iterator[tuple[int, Any, Any]]:
    spawn = multiprocessing.get_context("spawn")
    alive, ours = spawn.Pipe(duplex=False)
    with (
        _child_environment(),
        ProcessPoolExecutor(workers, spawn, initializer=_start_worker, initargs=(alive,)) as pool,
    ):

        def wait_for_results(pending: Any) -> list[tuple[Any, Any]]:
            return [(f, f.result()) for f in wait(pending, return_when=FIRST_COMPLETED).done]

        try:
            yield workers, partial(pool.submit, _run_guarded), wait_for_results
        except BaseException as error:
            ours.close()
            if not isinstance(error, BrokenProcessPool):
                raise
            raise InputError(
                "expected workers that live until their work is done, got one that has died; "
                "it may have been short of memory: use fewer workers or smaller pieces of work"
            ) from None


@contextmanager
def _child_environment() -> Iterator[None]:
    """Set variables of processes started in the block; libraries read them at import."""
    before = {name: os.environ.get(name) for name in _CHILD_VARIABLES}
    os.environ.update(_CHILD_VARIABLES)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


def _start_worker(alive: Connection) -> None:
    """A worker ends at once when its parent has ended, however that came, or wants no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_with_parent, args=(alive,), daemon=True).start()


def _exit_with_parent(alive: Connection) -> None:
    with suppress(EOFError, OSError):
        alive.recv()
    os._exit(0)


@contextmanager
def _ray_cluster() -> Iterator[tuple[int, Any, Any]]:
    ray = import_optional("ray", "ray")
    ours = not ray.is_initialized()
    if ours:
        ray.init(include_dashboard=False, log_to_driver=False)
    try:
        task = ray.remote(num_cpus=1, runtime_env={"env_vars": _CHILD_VARIABLES})(_run_remote_job)
        count = max(1, int(ray.cluster_resources().get("CPU", 1)))

        def wait_for_results(pending: Any) -> list[tuple[Any, Any]]:
            ray.wait(list(pending), num_returns=1)
            # All that have ended: a call takes 10 ms where thousands of pieces wait.
            done, _ = ray.wait(list(pending), num_returns=len(pending), timeout=0)
            return [(ticket, ray.get(ticket)) for ticket in done]

        yield count, task.remote, wait_for_results
    finally:
        if ours:
            ray.shutdown()


def _run_remote_job(work: Callable[[Any], Any], job: Any) -> Any:
    """A piece of work on a node of a cluster."""
    # Asked for with the task; a worker with more threads would give other bits.
    if threads.available_threads() != 1:
        return _WorkerError(
            f"expected workers of Ray with one thread, got OMP_NUM_THREADS = "
            f"{os.environ.get('OMP_NUM_THREADS')}; start the cluster with OMP_NUM_THREADS=1"
        )
    return _run_guarded(work, job)
