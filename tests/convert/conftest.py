"""Fixtures of the command line."""

from cli.conftest import run_file as run_file
