"""Digital twins from radar."""

__version__ = "0.1.0"
