"""The method of moments for small conductors."""
