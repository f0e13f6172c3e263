# %% [markdown]
# # Through a wall
#
# A person stands behind a wall of plasterboard. Waves of 60 GHz pass the board, weaker and a little later, and a fit
# finds the person.

# %%
# %matplotlib inline
import invertwin as iw
from invertwin.inversion import Optimizer
from invertwin.scene import Slab, person, standing_height

# %% [markdown]
# ## The scene
# The board is 12.5 mm thick, of the permittivity that ITU-R P.2040 lists. It reflects a part of the wave, and what
# passes is delayed: a point behind it seems 8 mm farther away.

# %%
body = person(spacing=0.05)
skin = iw.RoughDielectric(permittivity=8.0)
arms = {"left_shoulder": [1.2, 0.0, 0.0], "right_shoulder": [-1.2, 0.0, 0.0]}
up = standing_height(body)
someone = iw.Object(body.mesh(arms), skin, iw.rigid(translation=[2.4, 0.3, up]))
board = Slab.itu("plasterboard", thickness=0.0125)
wall = iw.Object(iw.plate(4.0, 3.0), board, iw.rigid(translation=[1.0, 0.0, 1.0]))
truth = iw.Scene({"person": someone, "wall": wall})

# %% [markdown]
# ## The recording
# Sixteen virtual antennas look through the wall from eight places.

# %%
chirp = iw.FMCW(start_frequency=60e9, bandwidth=3e9, duration=50e-6, samples=128)
radar = iw.Radar(
    iw.linear_array(2, 4 * chirp.wavelength),
    iw.linear_array(8, chirp.wavelength / 2),
    chirp,
    positions=[[0.0, y, z] for y in (-0.8, -0.3, 0.3, 0.8) for z in (1.1, 1.4)],
)
grid = radar.grid(range_min=1.6, range_max=3.6, u_max=0.6)
points = iw.Sampling(depth=1, points_per_m2=2e3)
recorded = iw.simulate(truth, radar, grid, seed=1, sampling=points, snr_db=30.0)
iw.plotting.spectrum({"recorded, the first place": recorded.spectrum.float()[:1]}, grid)

# %% [markdown]
# ## The fit
# The wall is known, and the person is 28 cm from where the fit starts. Gauss–Newton suits two parameters: ten steps are
# enough.

# %%
model = iw.SurrogateMap(
    grid,
    iw.Surrogate.for_start_error(0.3, radar),
    iw.Sampling(depth=1, samples=50_000, boundary_samples=8_000),
)
start = truth.replace("person", pose=iw.rigid(translation=[2.6, 0.1, up]))
fit = iw.reconstruct(
    start,
    iw.Observation(model, recorded.capture),
    iw.Translation("person", axes="xy"),
    optimizer=Optimizer("gauss_newton", rate=0.1),
    schedule=iw.Schedule(steps=10),
    seed=1,
)

# %%
miss = fit.scene["person"].center - truth["person"].center
bars = fit.uncertainty.interval()
print(f"{fit.verdict.word}: {100 * miss.norm():.1f} cm off")
print({name: f"± {100 * value:.1f} cm" for name, value in bars.items()})
assert miss.norm() < 0.05
assert not fit.uncertainty.early_stops

# %% [markdown]
# `early_stops` would name parameters for which the steps were too few. Try: Adam with 30 steps (no `optimizer`), which
# stops early; a wall of concrete (`Slab.itu("concrete", thickness=0.1)`), through which next to nothing passes.
