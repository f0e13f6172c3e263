# %% [markdown]
# # First twin
#
# A box stands in front of a wall. Its size is known, its position is not. A radar observes it from eight positions,
# and a fit estimates the position from the recording.

# %%
# %matplotlib inline
import invertwin as iw

# %% [markdown]
# ## The scene
# The radar is at the origin. x points away from the radar, y is left, and z is up. All lengths are in metres.

# %%
paint = iw.RoughDielectric(permittivity=4.0)
crate = iw.Object(iw.box((0.3, 0.4, 0.4)), paint, iw.rigid(translation=[2.2, 0.2, 0.0]))
wall = iw.Object(iw.plate(3.0, 2.0), paint, iw.rigid(translation=[3.2, 0.0, 0.0]))
truth = iw.Scene({"crate": crate, "wall": wall})

# %% [markdown]
# ## The radar
# Two transmitters and eight receivers make a row of sixteen virtual antennas. The radar has eight positions. `grid`
# defines the ranges and directions of the map.

# %%
chirp = iw.FMCW(start_frequency=77e9, bandwidth=2e9, duration=50e-6, samples=128)
radar = iw.Radar(
    iw.linear_array(2, 4 * chirp.wavelength),
    iw.linear_array(8, chirp.wavelength / 2),
    chirp,
    positions=[[0.0, y, z] for y in (-0.6, -0.2, 0.2, 0.6) for z in (-0.2, 0.2)],
)
grid = radar.grid(range_min=1.4, range_max=3.6, u_max=0.6)

# %% [markdown]
# ## The recording
# `simulate` computes exact signals with noise, as a board records them. Rough surfaces make speckle: bright and dark
# spots that belong to this surface and not to its shape.

# %%
few = iw.Sampling(depth=1, points_per_m2=2e3)
recorded = iw.simulate(truth, radar, grid, seed=1, sampling=few, snr_db=20.0)
capture = recorded.capture

# %% [markdown]
# ## The start
# The initial estimate is 25 cm from the true position. The model predicts the mean of the map over all speckle. At
# first it is blurred, which widens the basin of attraction; the blur is removed step by step.

# %%
start = truth.replace("crate", pose=iw.rigid(translation=[2.35, 0.0, 0.0]))
blur = iw.Surrogate(range_width=3.0, angle_width=1.5)
rays = iw.Sampling(depth=1, samples=50_000, boundary_samples=8_000)
model = iw.SurrogateMap(grid, blur, rays)
fit = iw.reconstruct(
    start,
    iw.Observation(model, capture),
    iw.Translation("crate", axes="xy"),
    schedule=iw.Schedule(steps=50),
    seed=1,
)

# %% [markdown]
# ## The result
# The maps of start and end beside the recording:

# %%
sharp = iw.SurrogateMap(grid, sampling=rays)
maps = {"recorded": recorded.spectrum.float()}
maps |= {
    name: sharp.predict(scene, radar, seed=1)
    for name, scene in (("start", start), ("found", fit.scene))
}
iw.plotting.spectrum(maps, grid)

# %% [markdown]
# The error, and the error bars of the fit:

# %%
miss = (fit.scene["crate"].center - truth["crate"].center).norm()
print(f"{100 * miss:.1f} cm off; standard deviations {fit.uncertainty.deviations}")
assert miss < 0.02

# %% [markdown]
# Try: a start that is 60 cm off, a smaller bandwidth, or `axes="xyz"`. A row of antennas hardly resolves height, and
# `fit.uncertainty.unobserved` lists it.
