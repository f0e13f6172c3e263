"""Seeds of their own for every key."""

from invertwin.seeds import derive_seed


def test_keys_have_seeds_of_their_own():
    """Stage, step and observation: no sum of them is mistaken for another."""
    keys = [(stage, step, k) for stage in range(4) for step in range(200) for k in range(3)]
    found = {derive_seed(seed, *key) for seed in range(3) for key in keys}
    assert len(found) == 3 * len(keys)
    assert all(0 <= seed < 2**31 for seed in found)


def test_the_first_seed_of_a_stage_is_not_that_of_another_start():
    """Start 0 in stage 1 shares nothing with start 1 in stage 0."""
    second = {derive_seed(0, 1, step, 0) for step in range(300)}
    other = {derive_seed(1, 0, step, 0) for step in range(300)}
    assert not second & other


def test_shorter_keys_are_keys_too():
    assert len({derive_seed(0), derive_seed(0, 0), derive_seed(0, 0, 0)}) == 3


def test_a_seed_is_the_same_on_every_machine():
    assert [derive_seed(0, 0, 0, 0), derive_seed(7, 1, 2)] == [1839233791, 1016141897]
