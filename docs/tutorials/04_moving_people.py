# %% [markdown]
# # Moving people
#
# A person walks towards the radar. Arms and legs move at speeds of their own, and the radar shows them as a pattern
# over time: micro-Doppler.

# %%
# %matplotlib inline
import invertwin as iw
from invertwin.plotting import MapPanel
from invertwin.radar import Chirps, micro_doppler, range_profile
from invertwin.scene import MovingScene, Walking, person, standing_height

# %% [markdown]
# ## A walking body
# `person` is a body with joints. `Walking` rotates the joints as people do at a given speed. `MovingScene` makes a
# scene that is a function of time.

# %%
body = person(spacing=0.05)
skin = iw.RoughDielectric(permittivity=8.0)
place = iw.rigid(translation=[5.0, 0.0, standing_height(body)])
scene = iw.Scene({"person": iw.Object(body.mesh({}), skin, place)})
walk = MovingScene(scene, {"person": Walking(body, speed=1.0)})
step = walk(1.0)["person"].center - walk(0.0)["person"].center
print(f"after a second: {-float(step[0]):.2f} m nearer")
assert abs(float(step[0]) + 1.0) < 0.1

# %% [markdown]
# ## Three quarters of a second of chirps
# Rays are traced once for every 48 chirps. In between, every point follows its limb, so that phases are exact.

# %%
chirp = iw.FMCW(start_frequency=77e9, bandwidth=0.5e9, duration=30e-6, samples=64)
antenna = iw.linear_array(1, chirp.wavelength / 2)
radar = iw.Radar(antenna, antenna, chirp, positions=[[0.0, 0.0, 1.0]])
train = Chirps(count=3072, interval=0.25e-3)
beat = iw.simulate_chirps(
    walk,
    radar,
    train,
    seed=1,
    sampling=iw.Sampling(depth=1, points_per_m2=300.0),
    visibility_every=48,
)

# %% [markdown]
# ## Speeds over time
# Each chirp becomes a range profile. The bins that hold the person are summed, and a short Fourier transform over the
# chirps shows the range rates of each moment. Negative ones approach.

# %%
grid = radar.grid(range_min=2.5, range_max=6.0)
every = radar.frames(
    [0] * train.count
)  # the radar rests: each chirp is a frame from the same place
profile = range_profile(beat[0], every, grid)[:, 0, 0]  # chirp, range
shown = micro_doppler(profile.T, radar, train, length=256, step=24)
power = shown.power.sum(0)
near = (shown.velocities > -5.0) & (shown.velocities < 2.0)
rates = MapPanel(power[:, near].T, shown.velocities[near], shown.times, "time [s]")
figure = iw.plotting.panels({"a person who walks": rates})
figure.axes[0].set_ylabel("range rate [m/s]")
figure

# %% [markdown]
# The trunk is the bright line near −1 m/s. A leg that swings forward is up to three times as fast.

# %%
trunk = shown.velocities[power.mean(0).argmax()]
levels = power.amax(0) / power.max()
fastest = shown.velocities[levels > 1e-3].min()
print(f"trunk {trunk:.2f} m/s, fastest limb {fastest:.2f} m/s")
assert abs(float(trunk) + 1.0) < 0.3
assert float(fastest) < -2.0
