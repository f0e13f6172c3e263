"""Beam tracing of few flat facets, with exact derivatives."""
