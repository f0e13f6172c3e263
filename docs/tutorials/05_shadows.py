# %% [markdown]
# # Shadows in the gradient
#
# A plate moves in front of a wall, and its shadow moves over the wall. The echo of the wall changes where the shadow
# boundary passes. Automatic differentiation of a ray tracer misses this change, since its rays are sampled at fixed
# points. invertwin adds paths that graze the edges, so its derivative includes it.

# %%
# %matplotlib inline
import torch

import invertwin as iw
from invertwin.inversion import GradcheckSettings, evaluate_losses, make_line

# %% [markdown]
# ## The scene
# The wall is bright behind the plate, so the shadow matters.

# %%
paint, dark = iw.RoughDielectric(permittivity=5.0), iw.RoughDielectric(permittivity=2.0)
front = iw.Object(iw.plate(0.5, 0.5), dark, iw.rigid(translation=[2.2, 0.1, 0.0]))
wall = iw.Object(iw.plate(3.0, 2.0), paint, iw.rigid(translation=[3.2, 0.0, 0.0]))
scene = iw.Scene({"plate": front, "wall": wall})
chirp = iw.FMCW(start_frequency=76e9, bandwidth=2e9, duration=50e-6, samples=128)
row = iw.linear_array(16, chirp.wavelength / 2)
radar = iw.Radar(iw.linear_array(1, 1.0), row, chirp, positions=[[0.0, 0.0, 0.0]])
grid = radar.grid(range_min=1.8, range_max=3.8, u_max=0.5)

# %% [markdown]
# ## Three derivatives of one map
# θ moves the plate to the left, in metres. `gradcheck` computes the derivative of every bin of the map by three
# methods: the difference of two maps, which is the truth; invertwin; and invertwin without boundary paths, which
# equals automatic differentiation of a ray tracer.

# %%
rays = iw.Sampling(depth=1, samples=400_000, boundary_samples=100_000)
report = iw.gradcheck(
    iw.SurrogateMap(grid, sampling=rays),
    iw.Translation("plate"),
    {"translation": [0.0, 1.0, 0.0]},
    scene=scene,
    sensor=radar,
    settings=GradcheckSettings(repeats=1, difference_samples=1_000_000, max_pairs=3, noise=0.05),
)
shown = {
    "by differences": report.difference,
    "invertwin": report.gradient,
    "without boundary paths": report.interior_gradient,
}
iw.plotting.gradient(shown, grid, power=report.value)

# %% [markdown]
# In the last picture the wall does not change at all: its own points are at rest, and visibility is fixed.

# %%
print(
    f"invertwin is {report.full.relative_l1:.3f} off, without boundary paths {report.interior.relative_l1:.2f}"
)
print(f"noise of the differences: {report.difference_noise:.3f}")
assert report.full.relative_l1 < 0.05
assert report.interior.relative_l1 > 0.15
at_wall = grid.ranges > 2.9
behind = report.interior_gradient[:, at_wall].abs().sum() / report.gradient[:, at_wall].abs().sum()
assert float(behind) < 0.05

# %% [markdown]
# ## Why a fit needs it
# The loss of a fit along the same line: it falls towards the truth from both sides. Its slope by invertwin fits the
# curve. Descent follows this slope, so a wrong slope leads elsewhere.

# %%
few = iw.Sampling(depth=1, points_per_m2=2e3)
data = iw.simulate(scene, radar, grid, seed=1, sampling=few)
capture = data.capture
model = iw.SurrogateMap(grid, iw.Surrogate(range_width=2.0, angle_width=1.0), rays)
seen = iw.Observation(model, capture)
line = make_line(iw.Translation("plate"), {"translation": [0.0, 1.0, 0.0]}, scene)
shifts = torch.linspace(-0.4, 0.4, 9)
losses = evaluate_losses(line, shifts.tolist(), seen, seed=1)
iw.plotting.convergence(losses.tolist())

# %%
best = float(shifts[losses.argmin()])
print(f"the smallest loss is {100 * best:+.0f} cm from the truth")
assert abs(best) < 0.11
