"""Smooth radar model: point spreads and expected power."""
