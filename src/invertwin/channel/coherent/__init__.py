"""Slow, readable implementations of the kernels' laws. Tests compare the kernels with them."""
