# %% [markdown]
# # Gestures
#
# A person waves at the radar. The forearm swings to and fro, its range rate rises and falls with it, and the rhythm of
# the hand is read from the micro-Doppler of the recording.

# %%
# %matplotlib inline
from scipy import signal

import invertwin as iw
from invertwin.plotting import MapPanel
from invertwin.radar import Chirps, micro_doppler, range_profile
from invertwin.scene import MovingScene, Waving, person, standing_height

# %% [markdown]
# ## A person who waves
# `Waving` raises an arm within 0.8 s and then swings the forearm at the given rate.

# %%
body = person(spacing=0.05)
skin = iw.RoughDielectric(permittivity=8.0)
place = iw.rigid(translation=[2.0, 0.0, standing_height(body)])
scene = iw.Scene({"person": iw.Object(body.mesh({}), skin, place)})
rate = 1.3
wave = MovingScene(scene, {"person": Waving(body, rate=rate)})

# %% [markdown]
# ## Three seconds of chirps
# A chirp every 0.8 ms shows range rates up to 1.5 m/s without aliasing. The hand stays below. Rays are traced once for
# every 256 chirps, and in between every point follows its limb.

# %%
chirp = iw.FMCW(start_frequency=60e9, bandwidth=1e9, duration=50e-6, samples=64)
antenna = iw.linear_array(1, chirp.wavelength / 2)
radar = iw.Radar(antenna, antenna, chirp, positions=[[0.0, 0.0, 1.2]])
train = Chirps(count=4096, interval=0.8e-3)
few = iw.Sampling(depth=1, points_per_m2=200.0)
beat = iw.simulate_chirps(wave, radar, train, seed=1, sampling=few, visibility_every=256)

# %% [markdown]
# ## Range rates over time

# %%
grid = radar.grid(range_min=1.2, range_max=3.0)
chirps = radar.frames([0] * train.count)  # the radar rests: each chirp is a frame from one place
profile = range_profile(beat[0], chirps, grid)[:, 0, 0]  # chirp, range
shown = micro_doppler(profile.T, radar, train, length=128, step=16)
power = shown.power.sum(0)  # time, range rate
rates = MapPanel(power.T, shown.velocities, shown.times, "time [s]")
figure = iw.plotting.panels({"a person who waves": rates})
figure.axes[0].set_ylabel("range rate [m/s]")
figure

# %% [markdown]
# ## The rhythm of the hand
# The trunk stands still, so bins near zero are left out. The mean range rate of the rest swings with the forearm. Its
# periodogram while the arm is up has one peak.

# %%
moving = shown.velocities.abs() > 0.15
swing = (power * shown.velocities)[:, moving].sum(1) / power[:, moving].sum(1)
up = (shown.times > 0.9) & (shown.times < 3.2)
interval = float(shown.times[1] - shown.times[0])
frequencies, strength = signal.periodogram(
    swing[up].numpy(), 1 / interval, window="hann", nfft=1 << 14, detrend="constant"
)
found = frequencies[strength.argmax()]
print(f"{found:.2f} Hz; the hand waves at {rate} Hz")
assert abs(found - rate) < 0.05

# %% [markdown]
# Try: `rate=0.9`, another seed, or `during=Walking(body, speed=1.0)`: the trunk then moves, too, and has to be taken
# off first.
