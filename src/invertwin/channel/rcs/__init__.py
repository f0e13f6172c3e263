"""Radar cross-sections in the far field."""
