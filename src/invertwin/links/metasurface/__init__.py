"""Reconfigurable surfaces on walls."""
