"""Outline models and shape proposals."""
