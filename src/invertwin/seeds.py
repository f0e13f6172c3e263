"""Independent random numbers from one seed."""

import numpy as np


def derive_seed(seed: int, *key: int) -> int:
    """A seed of its own for every key, independent of the seeds of all other keys.

    Args:
        seed: The seed from which others are derived.
        key: Numbers ≥ 0 that say what the seed is for, such as stage, step and observation.

    Returns:
        A number in [0, 2³¹). It is the same on every machine.
    """
    return int(np.random.SeedSequence(seed, spawn_key=key).generate_state(1, np.uint32)[0] >> 1)
