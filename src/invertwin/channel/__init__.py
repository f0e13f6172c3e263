"""Scene to paths to channel impulse response: the only room that knows the ray tracer."""
