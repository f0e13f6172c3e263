"""Scattered power: where paths start, how they go on, what they add to a map."""
