"""Rows of two tables with a number in common."""

import torch

from invertwin.channel.specular.ray_paths import match_rows


def test_pairs_are_those_of_all_equal_numbers_in_order():
    numbers = torch.Generator().manual_seed(0)
    first, second = (torch.randint(5, (n,), generator=numbers) for n in (40, 30))
    row, partner = match_rows(first, second, 5)
    assert torch.equal(torch.stack([row, partner], 1), (first[:, None] == second).nonzero())
    none = torch.zeros(0, dtype=torch.int64)
    assert [len(rows) for rows in match_rows(none, second, 5)] == [0, 0]
    assert [len(rows) for rows in match_rows(first, none, 5)] == [0, 0]
