"""Public recordings, each with its reader: examples of what a plugin may add."""
