"""Shapes that can be fitted: modules that map a scene to a scene with another mesh."""
