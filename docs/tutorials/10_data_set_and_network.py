# %% [markdown]
# # A data set and a network
#
# A network that detects objects in radar maps needs thousands of recordings with labels. Here is a small example: 120
# recordings with a crate at another position in each, and a network that learns to locate it.

# %%
# %matplotlib inline
import tempfile
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torch.utils.data import DataLoader

import invertwin as iw

# %% [markdown]
# ## A run file with distributions
# The sections are those of one simulation. `[dataset]` states the number of samples, and every `[[vary]]` names a key
# and its distribution. A wrong key is an error before any work.

# %%
RUN = """
frame = 2
task = "dataset"
seed = 1
[scene.crate]
shape = "box"
size = 0.4
position = [2.0, 0.0, 0.0]
material = { kind = "rough_dielectric", permittivity = 4.0 }
[radar]
waveform = { kind = "fmcw", start_frequency = 77e9, bandwidth = 0.5e9, duration = 50e-6, samples = 32 }
transmitters = { kind = "positions", positions = [[0.0, 0.0, 0.0]] }
receivers = { kind = "linear", count = 8, spacing = 1.93e-3 }
[grid]
range_min = 1.0
range_max = 4.6
u_max = 0.6
[data]
kind = "simulated"
points_per_m2 = 300.0
depth = 1
snr_db = 20.0
[dataset]
samples = 120
shard = 40
[[vary]]
key = "scene.crate.position"
kind = "uniform"
low = [1.6, -0.9, 0.0]
high = [3.4, 0.9, 0.0]
"""

# %% [markdown]
# ## Simulate and read
# `iw.dataset` writes tar files and returns the samples as a data set for PyTorch's loaders. More workers or machines
# give the same bytes. A notebook may call it as here. A script calls it below `if __name__ == "__main__":`, since
# workers import the script.


# %%
def example(sample: dict) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the input and target of the network: map in decibels, position of the crate (x, y)."""
    level = sample["map"][0, :, :, 0].clamp_min(1e-12).log10()
    crate = next(row for row in sample["labels"]["objects"] if row["name"] == "crate")
    return (level - level.max()).clamp_min(-3.0), torch.tensor(crate["oriented_box"]["center"][:2])


with tempfile.TemporaryDirectory() as folder:
    run_file = Path(folder, "crates.toml")
    run_file.write_text(RUN)
    iw.dataset(run_file, Path(folder, "crates"), workers=1)
    samples = iw.datasets.SampleDataset(
        Path(folder, "crates"), entries=["map", "labels"], transform=example
    )
    levels, places = next(iter(DataLoader(samples, batch_size=len(samples))))
print(tuple(levels.shape), "samples, ranges, directions")

# %% [markdown]
# ## A network
# Two layers. 100 samples train it, 20 test it.

# %%
torch.manual_seed(1)
network = torch.nn.Sequential(
    torch.nn.Flatten(), torch.nn.LazyLinear(32), torch.nn.ReLU(), torch.nn.Linear(32, 2)
)
network(levels[:1])  # sets the input size of the first layer
middle = places[:100].mean(0)
optimizer = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=0.1)
for _ in range(200):
    loss = (middle + network(levels[:100]) - places[:100]).square().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()

# %% [markdown]
# ## Its error
# On recordings that it has never seen. The baseline is the mean position.

# %%
with torch.no_grad():
    found = middle + network(levels[100:])
error = (found - places[100:]).norm(dim=1).mean()
guess = (middle - places[100:]).norm(dim=1).mean()
print(
    f"the network is {100 * error:.0f} cm off on average, guessing the middle {100 * guess:.0f} cm"
)
figure = Figure(figsize=(4.5, 4), layout="constrained")
axes = figure.subplots()
axes.plot(*places[100:].T.flip(0), "o", label="true")
axes.plot(*found.T.flip(0), "x", label="by the network")
axes.plot(*torch.stack([places[100:], found], 1).permute(2, 1, 0).flip(0), color="0.7")
axes.set(xlabel="y [m], to the left", ylabel="x [m]", aspect="equal")
axes.invert_xaxis()
axes.legend()
figure

# %%
assert error < 0.6 * guess

# %% [markdown]
# Next: [more about data sets](../datasets.md), and how a network [adapts to a room by a twin](../adaptation.md).
