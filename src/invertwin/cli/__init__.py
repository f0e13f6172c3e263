"""The command line: run files in, run folders out."""

from invertwin.registry.kinds import registry

registry.built_in = (
    "invertwin.cli.sensors",
    "invertwin.cli.materials",
    "invertwin.cli.shape_tables",
    "invertwin.cli.recordings",
    "invertwin.cli.fit_tables",
    "invertwin.cli.cross_sections",
    "invertwin.cli.radio_tables",
    "invertwin.cli.camera_tables",
    "invertwin.cli.schema.dataset",
)
