"""The command line: run files in, run folders out."""

from invertwin.registry.kinds import registry

registry.built_in = (
    "invertwin.cli.schema.sensors",
    "invertwin.cli.schema.materials",
    "invertwin.cli.schema.shape_tables",
    "invertwin.cli.schema.recordings",
    "invertwin.cli.schema.fit_tables",
    "invertwin.cli.schema.placement",
    "invertwin.cli.schema.cross_sections",
    "invertwin.cli.schema.radio_tables",
    "invertwin.cli.schema.camera_tables",
    "invertwin.cli.schema.dataset",
)
