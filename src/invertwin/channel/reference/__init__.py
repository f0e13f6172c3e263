"""Slow, readable statements of the kernels' laws: the oracles of their tests."""
