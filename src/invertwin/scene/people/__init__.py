"""Bodies, gait and gestures."""
