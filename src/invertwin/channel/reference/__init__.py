"""Slow, readable statements of the same laws: the oracles of the kernels' tests."""
