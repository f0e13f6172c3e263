# %% [markdown]
# # Planning positions
#
# Before anything is recorded, the simulation predicts the error bars of a fit, and the most useful further position
# of the radar.

# %%
# %matplotlib inline
from matplotlib.figure import Figure

import invertwin as iw
from invertwin.inversion import plan_error_bars, prepare_fit

# %% [markdown]
# ## The plan
# A box, of which x and y are unknown. The radar has two positions so far, close to each other. Four more are
# possible.

# %%
paint = iw.RoughDielectric(permittivity=4.0)
truth = iw.Scene(
    {"box": iw.Object(iw.box((0.3, 0.3, 0.3)), paint, iw.rigid(translation=[2.5, 0.1, 0.0]))}
)
here = [[0.0, -0.1, 0.0], [0.0, 0.1, 0.0]]
possible = [[0.0, 0.3, 0.0], [0.0, 0.0, 0.3], [0.0, -0.8, 0.0], [1.0, 0.0, 0.0]]
chirp = iw.FMCW(start_frequency=77e9, bandwidth=2e9, duration=50e-6, samples=128)
radar = iw.Radar(
    iw.linear_array(2, 4 * chirp.wavelength),
    iw.linear_array(8, chirp.wavelength / 2),
    chirp,
    positions=here + possible,
)
grid = radar.grid(range_min=1.0, range_max=3.6, u_max=0.6)

# %% [markdown]
# ## Error bars before the recording
# One simulated recording determines gain and noise. The fit starts at the truth, and `plan_error_bars` computes how
# far speckle and noise would move it. The last four frames are candidates: each is tried separately.

# %%
few = iw.Sampling(depth=1, points_per_m2=2e3)
recorded = iw.simulate(truth, radar, grid, seed=1, sampling=few, snr_db=20.0)
model = iw.SurrogateMap(grid, sampling=iw.Sampling(depth=1, samples=40_000, boundary_samples=8_000))
seen = iw.Observation(model, recorded.capture)
likely = iw.SpectrumLoss(kind="likelihood")
at_truth = prepare_fit(truth, [seen], iw.Translation("box", axes="xy"), loss=likely, seed=1)
now, added = plan_error_bars(at_truth, candidates=len(possible))
print("two positions:", {name: f"{100 * value:.1f} cm" for name, value in now.deviations.items()})
for one in added:
    print(f"with {possible[one.frame - len(here)]}: deviations times {one.deviation_ratio:.2f}")

# %% [markdown]
# The most useful position is hard to guess: here it is not the farthest one. So it pays to compute it.

# %%
figure = Figure(figsize=(5, 3.4), layout="constrained")
axes = figure.subplots()
axes.plot(*zip(*[(y, x) for x, y, _ in here], strict=True), "k^", label="there already")
places = [possible[one.frame - len(here)] for one in added]
dots = axes.scatter(
    [y for _, y, _ in places],
    [x for x, _, _ in places],
    c=[one.deviation_ratio for one in added],
    s=80,
)
axes.plot(0.1, 2.5, "s", markersize=14, color="0.6", label="box")
axes.set(xlabel="y [m], to the left", ylabel="x [m]", aspect="equal")
axes.invert_xaxis()
axes.legend(fontsize=8)
figure.colorbar(dots, label="deviations, times")
figure

# %%
assert all(one.deviation_ratio < 1.0 for one in added)
assert added[0].deviation_ratio < 0.85
assert all(one.error_bars.deviations["box.y"] < 1.02 * now.deviations["box.y"] for one in added)

# %% [markdown]
# `invertwin plan run.toml` does this from a run file, and with `fits` compares the plan with fits of as many
# simulated recordings ([run files](../run_files.md#error-bars-ambiguities-and-planning)).
