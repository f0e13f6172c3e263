"""The one schema of TOML run files: SI units, names as in the library, angles in `_deg` keys."""

from invertwin.cli.schema.fits import PlanTable as PlanTable
from invertwin.cli.schema.fits import SamplingBase as SamplingBase
from invertwin.cli.schema.fits import StageTable as StageTable
from invertwin.cli.schema.recordings import SimulatedData as SimulatedData
from invertwin.cli.schema.run import RawTable as RawTable
from invertwin.cli.schema.run import RunFile as RunFile
from invertwin.cli.schema.run import SceneFileTable as SceneFileTable
