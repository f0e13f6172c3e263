"""Method of moments for small conductors."""
