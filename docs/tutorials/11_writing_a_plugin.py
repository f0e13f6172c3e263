# %% [markdown]
# # Writing a plugin
#
# A plugin is a package of yours that adds materials, shapes, losses, models or commands to run files. Here we write
# one with a material, and use it in Python, in a fit, and in a run file.

# %%
# %matplotlib inline
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch

import invertwin as iw
from invertwin.inversion import Optimizer
from invertwin.scene import sphere

# %% [markdown]
# ## A package with a material
# Foliage returns the same share of the power at every angle, equally in all directions. A material hands the ray
# tracer a `ScatteringLaw`: the square root of its reflectance over the angle, and its diffuse share. The annotation
# `UnitFraction` limits the value to 0 … 1, and the docstring explains the key of the run file. `register` gets a registry and adds
# the contents of the package.

# %%
MODULE = '''
from dataclasses import dataclass
from typing import ClassVar

import torch

from invertwin.limits import UnitFraction
from invertwin.registry import Registry
from invertwin.scene import Material, ScatteringLaw

@dataclass(frozen=True)
class Foliage(Material):
    """Leaves: reflect the same share at every angle.

    Attributes:
        share: of the power that comes back.
    """

    share: UnitFraction | torch.Tensor = 0.05
    coherent: ClassVar[bool] = False  # a rough surface

    def scattering_law(self, frequency: float) -> ScatteringLaw:
        share = torch.as_tensor(self.share, dtype=torch.float64)
        amplitude = share.sqrt() * torch.ones(256, dtype=torch.float64)
        return ScatteringLaw(amplitude, torch.ones((), dtype=torch.float64))

def register(registry: Registry) -> None:
    registry.add("material", "foliage", Foliage)
'''

# %% [markdown]
# The package names this function in its `pyproject.toml`:
#
#     [project.entry-points."invertwin.plugins"]
#     foliage = "foliage:register"
#
# `pip install` creates the module and a folder with its metadata. Here we write both by hand, into a folder on
# Python's path.

# %%
folder = tempfile.TemporaryDirectory()
site = Path(folder.name)
(site / "foliage.py").write_text(MODULE)
(site / "foliage-1.0.dist-info").mkdir()
(site / "foliage-1.0.dist-info" / "METADATA").write_text("Name: foliage\nVersion: 1.0\n")
entry = "[invertwin.plugins]\nfoliage = foliage:register\n"
(site / "foliage-1.0.dist-info" / "entry_points.txt").write_text(entry)
sys.path.append(folder.name)

from foliage import Foliage  # type: ignore  # noqa: E402

# %% [markdown]
# ## Use in Python
# Twice the share is twice the power.

# %%
bush = iw.Object(sphere(0.3), Foliage(0.05), iw.rigid(translation=[2.0, 0.0, 0.0]))
scene = iw.Scene({"bush": bush})
chirp = iw.FMCW(start_frequency=77e9, bandwidth=2e9, duration=50e-6, samples=128)
radar = iw.Radar(
    iw.linear_array(1, 1.0), iw.linear_array(16, chirp.wavelength / 2), chirp, [[0.0, 0.0, 0.0]]
)
grid = radar.grid(range_min=1.4, range_max=2.4, u_max=0.4)
model = iw.SurrogateMap(grid, sampling=iw.Sampling(depth=1, samples=50_000, boundary_samples=5_000))
thin = model.predict(scene, radar, seed=1)
dense = model.predict(scene.replace("bush", material=Foliage(0.10)), radar, seed=1)
assert abs(float(dense.sum() / thin.sum()) - 2.0) < 1e-4
iw.plotting.spectrum({"a bush": thin}, grid)


# %% [markdown]
# ## Something to fit
# An unknown is a torch module that maps a scene to a scene. This one finds the share from a recording.


# %%
class Thickness(torch.nn.Module):
    """Reflected share of the power of the bush."""

    def __init__(self) -> None:
        super().__init__()
        self.logit = torch.nn.Parameter(torch.tensor(-4.0, dtype=torch.float64))

    def forward(self, scene: iw.Scene) -> iw.Scene:
        return scene.replace("bush", material=Foliage(self.logit.sigmoid()))

    def values(self) -> dict[str, Any]:
        return {"bush.share": self.logit.detach().sigmoid()}


places = radar.frames([0] * 12)  # twelve frames: each has other speckle below
recordings = [
    iw.simulate(
        scene, radar, grid, seed=look, sampling=iw.Sampling(depth=1, points_per_m2=2e3)
    ).beat
    for look in range(12)
]
capture = iw.Capture.from_beat(torch.cat(recordings), places)
unknown = Thickness()
fit = iw.reconstruct(
    scene,
    iw.Observation(model, capture, sensor=places),
    unknown,
    loss=iw.SpectrumLoss(kind="likelihood", gain="one"),
    optimizer=Optimizer(rate=0.1),  # of the logit
    schedule=iw.Schedule(steps=60),
    seed=1,
)
share = float(unknown.logit.detach().sigmoid())
print(f"share {share:.3f}, true 0.05")
assert abs(share - 0.05) < 0.015


# %% [markdown]
# ## A run file that names it
# The command line finds the plugin automatically. `check` estimates the resources of a run, without running it.

# %%
RUN = """
frame = 2
task = "simulate"
[scene.bush]
shape = "sphere"
radius = 0.3
position = [2.0, 0.0, 0.0]
material = { kind = "foliage", share = 0.07 }
[radar]
positions = [[0.0, 0.0, 0.0]]
transmitters = { kind = "positions", positions = [[0.0, 0.0, 0.0]] }
receivers = { kind = "linear", count = 16, spacing = 1.93e-3 }
[radar.waveform]
kind = "fmcw"
start_frequency = 77e9
bandwidth = 2e9
duration = 50e-6
samples = 128
[grid]
range_min = 1.4
range_max = 2.4
[data]
kind = "simulated"
points_per_m2 = 2e3
"""


def invertwin(*words: str) -> subprocess.CompletedProcess[str]:
    """The command line, with the plugin."""
    places = os.pathsep.join([folder.name, os.environ.get("PYTHONPATH", "")])
    line = [sys.executable, "-m", "invertwin", *words]
    known = os.environ | {"PYTHONPATH": places}
    return subprocess.run(line, env=known, capture_output=True, text=True)


(site / "bush.toml").write_text(RUN)
ended = invertwin("check", str(site / "bush.toml"))
print(ended.stdout)
assert ended.returncode == 0, ended.stderr

# %% [markdown]
# A wrong value is an error of one line that names its key:

# %%
(site / "wrong.toml").write_text(RUN.replace("0.07", "7.0"))
ended = invertwin("check", str(site / "wrong.toml"))
print(ended.stderr)
assert ended.returncode == 2
assert "scene.bush.material.share" in ended.stderr
folder.cleanup()

# %% [markdown]
# `tests/plugins/example_plugin` is a whole package to start from. [Extending](../extending.md) has the groups.
