"""The one schema of TOML run files: SI units, names as in the library, angles in `_deg` keys."""

from invertwin.cli.materials import MaterialValue
from invertwin.cli.recordings import SimulatedData
from invertwin.cli.schema.fits import Initial, Reconstruct, Settings, Stage, Starts, Variant
from invertwin.cli.schema.run import (
    ObservationTable,
    Raw,
    RunFile,
    SceneFile,
    Truth,
    run_file_model,
)
from invertwin.cli.schema.studies import Gradcheck, GradientParameter, LossScan
from invertwin.cli.shape_tables import ObjectTable, Placement

__all__ = [
    "Gradcheck",
    "GradientParameter",
    "Initial",
    "LossScan",
    "MaterialValue",
    "ObjectTable",
    "ObservationTable",
    "Placement",
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
    "run_file_model",
]
