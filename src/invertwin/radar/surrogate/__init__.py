"""The smooth radar model: point spreads and expected power."""
