"""The one schema of TOML run files: SI units, names as in the library, angles in `_deg` keys."""

from invertwin.cli.recordings import SimulatedData
from invertwin.cli.schema.fits import Initial, Reconstruct, Settings, Stage, Starts, Variant
from invertwin.cli.schema.gradcheck import Gradcheck
from invertwin.cli.schema.run import ObservationTable, Raw, RunFile, SceneFile, Truth

__all__ = [
    "Gradcheck",
    "Initial",
    "ObservationTable",
    "Raw",
    "Reconstruct",
    "RunFile",
    "SceneFile",
    "Settings",
    "SimulatedData",
    "Stage",
    "Starts",
    "Truth",
    "Variant",
]
