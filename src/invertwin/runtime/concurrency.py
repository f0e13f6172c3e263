"""Locks and thread counts where torch and the ray tracer work in one process."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

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
