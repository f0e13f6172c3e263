# %% [markdown]
# # Camera and radar
#
# A camera sees outlines: it locates an object well across its view, and badly in depth. A radar measures ranges. One
# fit uses both.

# %%
# %matplotlib inline
import invertwin as iw
from invertwin.camera import Camera, ImageSampling, photograph
from invertwin.models import SilhouetteMap

# %% [markdown]
# ## A crate before both
# Camera and radar are at the origin and look along x.

# %%
paint = iw.RoughDielectric(permittivity=4.0)
truth = iw.Scene(
    {"crate": iw.Object(iw.box((0.4, 0.4, 0.4)), paint, iw.rigid(translation=[3.0, 0.2, 0.1]))}
)
start = truth.replace("crate", pose=iw.rigid(translation=[3.15, 0.1, 0.0]))

camera = Camera.look_at(
    [[0.0, 0.0, 0.0]], [3.0, 0.0, 0.0], width=48, height=36, field_of_view=0.7, up=[0.0, 0.0, 1.0]
)
picture = photograph(truth, camera, seed=1, wrong_labels=0.1)
mask = picture.mask("crate")
masks = SilhouetteMap(("crate",), sampling=ImageSampling(samples=16))
shown = {"photographed": mask[0], "at the start": masks.predict(start, camera, seed=1)[0]}
iw.plotting.images({name: values.detach() for name, values in shown.items()})

# %% [markdown]
# The radar has one transmitter and four receivers: little resolution in direction, but a range to a few centimetres.

# %%
chirp = iw.FMCW(start_frequency=77e9, bandwidth=2e9, duration=50e-6, samples=128)
radar = iw.Radar(
    iw.linear_array(1, 1.0), iw.linear_array(4, chirp.wavelength / 2), chirp,
    positions=[[0.0, y, z] for y in (-0.05, 0.05) for z in (-0.05, 0.05)],
)  # fmt: skip
grid = radar.grid(range_min=2.0, range_max=4.0, u_max=0.6)
data = iw.simulate(
    truth, radar, grid, seed=1, sampling=iw.Sampling(depth=1, points_per_m2=3e3), snr_db=15.0
)
capture = data.capture

# %% [markdown]
# ## Three fits
# By the mask alone, by the radar alone, and by both. An `Observation` joins a model and the data of a sensor; a list of
# them is one fit. A capture has its radar; a mask does not have its camera, so it is given.

# %%
by_camera = iw.Observation(masks, mask, sensor=camera, loss=iw.SpectrumLoss("mse", gain="one"))
rays = iw.Sampling(depth=1, samples=40_000, boundary_samples=8_000)
model = iw.SurrogateMap(grid, iw.Surrogate(range_width=3.0, angle_width=1.0), rays)
by_radar = iw.Observation(model, capture)
misses = {}
for name, seen in {
    "camera": [by_camera],
    "radar": [by_radar],
    "both": [by_camera, by_radar],
}.items():
    fit = iw.reconstruct(
        start, seen, iw.Translation("crate"), schedule=iw.Schedule(steps=40), seed=1
    )
    misses[name] = fit.scene["crate"].center - truth["crate"].center
    x, y, z = (100 * misses[name]).tolist()
    print(f"{name:>6}: {x:+5.1f}, {y:+5.1f}, {z:+5.1f} cm off in x, y, z")

# %% [markdown]
# The camera is good across and worse in depth, the radar conversely. Both together are good in all directions.

# %%
across = {name: float(miss[1:].norm()) for name, miss in misses.items()}
total = {name: float(miss.norm()) for name, miss in misses.items()}
assert across["radar"] > 2 * across["both"]
assert total["both"] < 0.03
assert total["both"] < 0.5 * min(total["camera"], total["radar"])
