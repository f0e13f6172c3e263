"""The one schema of TOML run files: SI units, names as in the library, angles in `_deg` keys."""

from invertwin.cli.schema.fits import SAMPLED as SAMPLED
from invertwin.cli.schema.fits import Measures as Measures
from invertwin.cli.schema.fits import Plan as Plan
from invertwin.cli.schema.fits import Reconstruct as Reconstruct
from invertwin.cli.schema.fits import Stage as Stage
from invertwin.cli.schema.gradcheck import Gradcheck as Gradcheck
from invertwin.cli.schema.recordings import SimulatedData as SimulatedData
from invertwin.cli.schema.run import ObservationTable as ObservationTable
from invertwin.cli.schema.run import Raw as Raw
from invertwin.cli.schema.run import RunFile as RunFile
from invertwin.cli.schema.run import SceneFile as SceneFile
