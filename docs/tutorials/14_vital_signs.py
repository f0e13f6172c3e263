# %% [markdown]
# # Vital signs
#
# A person sits still before a radar of 60 GHz. Breathing moves the chest by millimetres, the heart by tenths of one. Both
# are read from the phase of the echo, and the depth of a breath is fitted through the simulation.

# %%
# %matplotlib inline
import math

import torch
from matplotlib.figure import Figure

import invertwin as iw
from invertwin.channel import draw_speckle
from invertwin.radar import Chirps, estimate_displacement, estimate_vital_signs, range_profile
from invertwin.scene import Breathing, MovingScene, person, standing_height

# %% [markdown]
# ## A person who breathes
# `Breathing` displaces the front of the chest along its normal. Skin is almost smooth at 60 GHz, so most of its echo
# lies in a lobe.

# %%
body = person(spacing=0.03)
skin = iw.RoughDielectric(permittivity=8.0, diffuse=0.2, lobe_width=math.radians(20.0))
place = iw.rigid(translation=[1.5, 0.0, standing_height(body)])
scene = iw.Scene({"person": iw.Object(body.mesh({}), skin, place)})
truth = Breathing(body, rate=0.27, depth=8e-3, heart_rate=1.15, heart_depth=4e-4)

chirp = iw.FMCW(start_frequency=60e9, bandwidth=2e9, duration=50e-6, samples=64)
antenna = iw.linear_array(1, chirp.wavelength / 2)
radar = iw.Radar(antenna, antenna, chirp, positions=[[0.0, 0.0, 1.3]])
grid = radar.grid(range_min=1.0, range_max=2.2)

# %% [markdown]
# ## Forty seconds of chirps
# A chirp every 50 ms. Rays are traced every two seconds, and in between every point follows the skin.

# %%
train = Chirps(count=800, interval=0.05)
few = iw.Sampling(depth=1, points_per_m2=1000.0, boundary=False)
moving = MovingScene(scene, {"person": truth})
beat = iw.simulate_chirps(moving, radar, train, seed=1, sampling=few, visibility_every=40)
beat = beat + 0.1 * beat.abs().square().mean().sqrt() * torch.randn(
    beat.shape, dtype=beat.dtype, generator=torch.Generator().manual_seed(1)
)

# %% [markdown]
# ## Breathing and heartbeat
# `estimate_vital_signs` takes range profiles over time. It picks a range bin that varies and whose samples lie on
# a circle, removes what stands still, and unwraps the phase. A frequency comes with its standard deviation.

# %%
frames = radar.frames([0] * train.count)  # the radar rests: each chirp is a frame from one place
profile = range_profile(beat[0], frames, grid)
seen = estimate_vital_signs(profile, radar, grid, interval=train.interval)
breathing, heart = seen.breathing, seen.heart
assert breathing
assert heart
print(f"breathing {breathing.frequency:.3f} Hz, {1e3 * breathing.depth:.1f} mm")
print(f"heart     {heart.frequency:.3f} Hz, {1e3 * heart.depth:.2f} mm")
assert abs(breathing.frequency - truth.rate) < 0.01
assert abs(heart.frequency - truth.heart_rate) < 0.03
figure = Figure(figsize=(7, 3), layout="constrained")
axes = figure.add_subplot(xlabel="time [s]", ylabel="towards the radar [mm]")
axes.plot(seen.times, 1e3 * seen.displacement)
figure

# %% [markdown]
# ## The depth by a fit through the simulation
# What the radar sees is a mean over the chest, which moves less at its sides than in the middle. For one breath of the
# depth θ the simulation gives what the radar would see, and the derivative with respect to θ. Its speckle differs from
# that of the recording. Of four, the one is used whose samples lie best on a circle.

# %%
share = torch.arange(48, dtype=torch.float64) / 48  # of a breath


def simulate_depth(depth: torch.Tensor, seed: int) -> tuple[torch.Tensor, float]:
    """Depth that the radar sees, and the roundness of its samples."""
    one = MovingScene(scene, {"person": Breathing(body, truth.rate, depth, heart_depth=0.0)})
    speckle = draw_speckle(one(0.0), radar.link(), few, seed)
    shots = [
        iw.simulate(
            one(float(part) / truth.rate), radar, grid, seed=seed, sampling=few, speckle=speckle
        )
        for part in share
    ]
    profile = torch.stack([range_profile(shot.beat, radar, grid)[0, 0, 0] for shot in shots])
    moved, roundness, variance = estimate_displacement(profile, radar)
    best = int((roundness * variance).argmax())
    return -4 * (moved[:, best] * torch.cos(2 * torch.pi * share)).mean(), float(
        roundness[best].detach()
    )


depth = torch.tensor(5e-3, dtype=torch.float64, requires_grad=True)
with torch.no_grad():
    seed = max(range(10, 14), key=lambda number: simulate_depth(depth, number)[1])
for _ in range(2):  # Gauss–Newton: one unknown, one value
    value, _ = simulate_depth(depth, seed)
    (slope,) = torch.autograd.grad(value, depth)
    print(
        f"θ {1e3 * float(depth.detach()):.2f} mm, seen {1e3 * float(value.detach()):.2f} mm, derivative {slope:.2f}"
    )
    with torch.no_grad():
        depth += (breathing.depth - value) / slope
found = float(depth.detach())
print(
    f"depth {1e3 * found:.2f} mm of {1e3 * float(truth.depth):.2f} mm; from the phase alone {1e3 * breathing.depth:.2f} mm"
)
assert abs(found - truth.depth) < 0.1 * truth.depth

# %% [markdown]
# Try: `diffuse=1.0`, a matt skin, or a person who faces 20° past the radar. Both frequencies stay right. The depth may
# come out too small, since parts of the skin that move less then echo as much as the chest.
