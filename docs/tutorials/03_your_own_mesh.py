# %% [markdown]
# # Your own mesh
#
# A shape may come from any program that writes OBJ, PLY, STL or glTF. Here another library makes a file in
# millimetres, and a radar observes it.

# %%
# %matplotlib inline
import math
import tempfile
import warnings
from pathlib import Path

import torch
import trimesh

import invertwin as iw
from invertwin.scene import rotation_from_vector

# %% [markdown]
# ## A file
# A mug: a tube with a bottom, 92 mm high. It has many narrow triangles: on a smooth metal, coarse facets would glint
# like a disco ball, and a warning is issued. The tube stands in its bottom, as parts of such files often do: `load_mesh`
# leaves out what lies inside, and says so in a warning.

# %%
tube = trimesh.creation.annulus(r_min=36.0, r_max=40.0, height=90.0, sections=512)
bottom = trimesh.creation.cylinder(radius=40.0, height=4.0, sections=512)
bottom.apply_translation([0.0, 0.0, -45.0])
with tempfile.TemporaryDirectory() as folder:
    file = Path(folder, "mug.stl")
    trimesh.util.concatenate([tube, bottom]).export(file)
    with warnings.catch_warnings(record=True, action="always") as issued:
        mug = iw.load_mesh(file, unit="mm")
print(*(entry.message for entry in issued), mug.summary(), sep="\n")

# %% [markdown]
# Without `unit` the mug would be 92 m high, and `load_mesh` would warn. The file has z up, as the
# world has. A pose turns the mug by 30° about z and puts it 1.5 m away: first the rotation, then the translation.

# %%
yaw = rotation_from_vector(torch.tensor([0.0, 0.0, math.radians(30.0)]))
pose = iw.rigid(yaw, torch.tensor([1.5, 0.2, 0.0]))
scene = iw.Scene({"mug": iw.Object(mug, iw.PerfectConductor(), pose)})
height = scene["mug"].vertices[:, 2]
assert abs(float(height.max() - height.min()) - 0.092) < 1e-6

# %% [markdown]
# ## Its echo
# Metal is smooth, so exact signals need many samples and no random surface.

# %%
chirp = iw.FMCW(start_frequency=77e9, bandwidth=3.6e9, duration=50e-6, samples=128)
radar = iw.Radar(
    iw.linear_array(2, 8 * chirp.wavelength),
    iw.linear_array(16, chirp.wavelength / 2),
    chirp,
    [[0.0, 0.0, 0.0]],
)
grid = radar.grid(range_min=1.0, range_max=2.2, u_max=0.5)
data = iw.simulate(scene, radar, grid, seed=1, sampling=iw.Sampling(depth=1))
iw.plotting.spectrum(data.spectrum, grid)

# %% [markdown]
# The strongest echo comes from the front of the mug, 4 cm before its axis:

# %%
row, column = divmod(int(data.spectrum.argmax()), grid.u_count)
print(f"{grid.ranges[row]:.3f} m away, u = {grid.u[column]:+.2f}")
axis = math.hypot(0.2, 1.5)
assert abs(float(grid.ranges[row]) - (axis - 0.04)) < 0.03
assert abs(float(grid.u[column]) - 0.2 / axis) < 0.05

# %% [markdown]
# ## Rough, not smooth
# With rough paint, the mug has speckle, and the mean over all speckle is smooth. Fits use this mean. Their unknown
# may be the pose of the mesh, its size, its material, or every vertex of it.

# %%
painted = scene.replace("mug", material=iw.RoughDielectric(permittivity=4.0))
mean = iw.SurrogateMap(grid, sampling=iw.Sampling(depth=1)).predict(painted, radar, seed=1)
iw.plotting.spectrum({"rough, on average": mean}, grid)

# %%
row, column = divmod(int(mean.argmax()), grid.u_count)
assert abs(float(grid.ranges[row]) - (axis - 0.04)) < 0.03
