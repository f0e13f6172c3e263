"""Initial estimates and multi-start fits."""
