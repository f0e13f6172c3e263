# %% [markdown]
# # Coverage and a metasurface
#
# A transmitter stands in a room behind a metal screen. A map shows its coverage. A metasurface on the wall, a panel
# of small elements that shift the phase of the field they scatter, directs power into the shadow.

# %%
# %matplotlib inline
import torch

import invertwin as iw
from invertwin.links import (
    MapPlane,
    Metasurface,
    PanelPlacement,
    PropagationSettings,
    ReceiverPoints,
    Transmitters,
    WallPath,
)
from invertwin.scene import Slab

# %% [markdown]
# ## The room
# The room is 6 m × 4 m, and the screen stands between the transmitter and the far corner.

# %%
room = iw.Object(
    iw.box([6.0, 4.0, 2.7]),
    Slab.itu("concrete", thickness=0.2),
    iw.rigid(translation=[3.0, 2.0, 1.35]),
)
screen = iw.Object(
    iw.box([0.1, 2.2, 2.0]), iw.PerfectConductor(), iw.rigid(translation=[3.0, 1.2, 1.0])
)
scene = iw.Scene({"room": room, "screen": screen})
sender = Transmitters(torch.tensor([[0.6, 0.8, 1.2]]).double())

# %% [markdown]
# ## A map
# Mean path gain of cells of 25 cm, 1.2 m above the floor: line of sight, and single reflections by walls and screen.

# %%
plane = MapPlane.horizontal([0.05, 0.05], [5.9, 3.9], 1.2, 0.25)
model = iw.RadioMap(plane, PropagationSettings(5.0e9, depth=1), "gain")
gain = model.predict(scene, sender, seed=0)[0].clamp_min(1e-12)
levels = {"path gain": 10 * gain.log10()}
iw.plotting.coverage(levels, plane, scene=scene, transmitters=sender)

# %% [markdown]
# ## A receiver in the shadow
# It receives reflections by the walls. Without walls it would receive nothing.

# %%
receiver = torch.tensor([[5.2, 0.6, 1.2]]).double()
spot = ReceiverPoints(receiver)
before = iw.RadioMap(spot, PropagationSettings(5.0e9, depth=1), "gain").predict(
    scene, sender, seed=0
)

# %% [markdown]
# ## A panel on the wall
# The panel hangs on the far wall, at y = 4 m, somewhere along a line. `PanelPlacement` focuses it from the
# transmitter on the receiver. It is a torch module: its position on the wall, its yaw and all its phases can be
# fitted.

# %%
wall = WallPath([[5.5, 3.95], [0.5, 3.95]], height=1.2)  # the room is on its left
flat = torch.zeros(32, 32, dtype=torch.float64)
here = torch.zeros(3, dtype=torch.float64)
plain = Metasurface(here, torch.eye(3, dtype=torch.float64), flat, spacing=0.03)


def with_panel(along: float) -> torch.Tensor:
    placed = PanelPlacement(wall, sender.positions[0], receiver[0], 5.0e9, (32, 32), along=along)
    reception = PropagationSettings(5.0e9, depth=1, panels=[placed(plain)])
    return iw.RadioMap(spot, reception, "gain").predict(scene, sender, seed=0)


places = [0.5, 1.5, 2.5, 3.5, 4.5]
after = torch.stack([with_panel(along).detach().squeeze() for along in places])
for along, value in zip(places, after, strict=True):
    print(f"{along:.1f} m along the wall: {10 * float((value / before).log10()):+.1f} dB")

# %% [markdown]
# ## Its effect on the room
# The best of these positions, as a map of points: bright where the panel radiates.

# %%
best = places[int(after.argmax())]
xs, ys = torch.linspace(3.3, 5.9, 14).double(), torch.linspace(0.1, 3.7, 19).double()
grid = torch.stack(torch.meshgrid(xs, ys, indexing="ij"), -1)
points = ReceiverPoints(torch.cat([grid, torch.full_like(grid[..., :1], 1.2)], -1).reshape(-1, 3))
focus = PanelPlacement(wall, sender.positions[0], receiver[0], 5.0e9, (32, 32), along=best)
lit = iw.RadioMap(
    points, PropagationSettings(5.0e9, depth=1, panels=[focus(plain)]), "gain"
).predict(scene, sender, seed=0)
window = MapPlane.horizontal([3.2, 0.0], [6.0, 3.8], 1.2, 0.2)
iw.plotting.coverage(
    {"with the panel": 10 * lit.detach().clamp_min(1e-12).log10().reshape(14, 19)},
    window,
    scene=scene,
)

# %%
gained = 10 * float((after.max() / before).log10())
print(f"the receiver gets {gained:.1f} dB more")
assert gained > 3.0

# %% [markdown]
# `invertwin reconstruct experiments/metasurface.toml` searches position, yaw and phases for the worst receivers of a
# room ([run files](../run_files.md#a-metasurface)).
