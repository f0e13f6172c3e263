"""Receiving surfaces: shadow boundaries and single scattering."""
