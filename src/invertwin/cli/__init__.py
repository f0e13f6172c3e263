"""The command line: run files in, run folders out."""

from invertwin.registry.kinds import registry

_SCHEMA = ("sensors", "materials", "shape_tables", "recordings", "fit_tables", "placement")
_SCHEMA += ("cross_sections", "radio_tables", "camera_tables", "dataset")
registry.built_in = tuple(f"invertwin.cli.schema.{name}" for name in _SCHEMA)
