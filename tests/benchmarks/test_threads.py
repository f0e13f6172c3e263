"""The benchmark of threads compares fits."""

import pytest
import torch


def test_apart_is_the_largest_difference(threads):
    first = [torch.tensor([1.0, 2.0]), torch.tensor([3.0])]
    assert threads.apart(first, [torch.tensor([1.0, 2.5]), torch.tensor([2.75])]) == 0.5


def test_a_repetition_without_numbers_counts(threads, monkeypatch):
    monkeypatch.setattr(threads.sys, "executable", "/bin/false")
    found = threads.measure(2, 1)
    assert found["aborts"] == 2
    assert found["largest_difference"] is None


@pytest.mark.slow
def test_fits_in_threads_equal_those_one_after_the_other(threads):
    assert threads.compared(4)["largest_difference"] <= 1e-6
