"""Locks and thread counts where torch and the ray tracer work in one process."""

import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import torch

tracer_lock = threading.RLock()
"""Held while rays are traced, or a level of forward-mode derivatives is open."""


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Limit the threads of torch inside a ``with`` block.

    Between torch's operations its threads spin for a while, on the cores that trace rays. So torch
    gets one thread for small work, and half of the cores where torch and rays work in turns.

    Args:
        count: number of threads, ≥ 1.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def run_alongside(function: Callable[[Any], None], items: Iterable[Any]) -> None:
    """Call a function of each item in a second thread, in order, while the next item is made.

    At most two items exist at a time.

    Args:
        function: function of an item; not of tensors that ``torch.func`` transforms,
            whose state is that of one thread.
        items: iterable whose items are worth a thread, such as rays that are traced for each.
    """
    with ThreadPoolExecutor(1) as second:
        last = second.submit(tuple)
        for item in items:
            last.result()
            last = second.submit(function, item)
        last.result()
