"""Automatic derivatives against central differences."""
