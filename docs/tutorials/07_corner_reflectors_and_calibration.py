# %% [markdown]
# # Corner reflectors and calibration
#
# A corner reflector returns waves to their source over a wide range of angles, and its cross-section has a closed
# form. So it is the usual calibration target. First its cross-section, then a board whose channels have errors.

# %%
# %matplotlib inline
import math

import torch

import invertwin as iw
from invertwin.capture import estimate_channels
from invertwin.radar import channel_errors
from invertwin.scene import sphere, trihedral
from invertwin.signatures import aspect_directions, to_dbsm

# %% [markdown]
# ## Cross-section
# A trihedral of three triangles with legs of 10 cm. After three bounces, the whole wave returns. `theta` moves the
# radar about the axis of the corner.

# %%
corner = iw.Scene({"corner": iw.Object(trihedral(0.1), iw.PerfectConductor())})
degrees = torch.linspace(70.0, 110.0, 41, dtype=torch.float64)
found = iw.rcs(corner, aspect_directions(torch.deg2rad(degrees), math.pi), [77e9])
curves = {
    "all": found.dbsm[0, :, 0, 0],
    "three bounces": to_dbsm(found.parts["order 3"])[0, :, 0, 0],
}
iw.plotting.rcs_curves(
    {"trihedral of 10 cm at 77 GHz": curves}, degrees - 90, "angle from the axis [°]"
)

# %%
wavelength = 299_792_458 / 77e9
formula = 10 * math.log10(4 * math.pi * 0.1**4 / (3 * wavelength**2))
print(f"{float(curves['three bounces'][20]):.2f} dBsm on the axis, formula {formula:.2f} dBsm")
assert abs(float(curves["three bounces"][20]) - formula) < 0.01

# %% [markdown]
# ## A board with errors
# Lines to the antennas have different lengths, and amplifiers differ. Every channel is multiplied by an unknown gain
# and phase, here random: 1 dB and 0.6 rad.

# %%
chirp = iw.FMCW(start_frequency=77e9, bandwidth=1e9, duration=50e-6, samples=64)
radar = iw.Radar(
    iw.linear_array(2, 4 * chirp.wavelength),
    iw.linear_array(8, chirp.wavelength / 2),
    chirp,
    [[0.0, 0.0, 0.0]],
)
grid = radar.grid(range_min=1.5, range_max=3.0, u_max=0.8)
place = [2.2, 0.5, 0.0]
ball = iw.Object(sphere(0.05, 5), iw.PerfectConductor(), iw.rigid(translation=place))
clean = iw.simulate(
    iw.Scene({"ball": ball}),
    radar,
    grid,
    seed=1,
    sampling=iw.Sampling(depth=1, conductor_samples=100_000),
)
errors = channel_errors(radar, gain_std_db=1.0, phase_std=0.6, seed=3)
measured = iw.Capture.from_beat(clean.beat * errors[None, :, :, None], radar)

# %% [markdown]
# ## The calibration
# A small bright target is placed at a surveyed position, here a metal ball. Each channel is compared with the echo of
# an ideal point there. The echo comes from the front of the ball, not from its centre.

# %%
centre = torch.tensor(place, dtype=torch.float64)
front = centre - 0.05 * centre / centre.norm()
calibration = estimate_channels(measured, front)
mended = calibration.apply(measured)
maps = {
    "with errors": measured.spectrum(grid),
    "calibrated": mended.spectrum(grid),
    "without errors": clean.spectrum,
}
iw.plotting.spectrum(maps, grid, relative=False)

# %% [markdown]
# The gains are right up to one common factor, which cannot be distinguished from the strength of the echo:

# %%
ratio = calibration.gains / errors
left = (ratio / ratio.mean()).angle().abs().max()
print(
    f"largest error of phase: {float(errors.angle().abs().max()):.2f} rad before, {float(left):.3f} rad after"
)
assert float(left) < 0.05
peaks = {name: 10 * math.log10(float(power.max())) for name, power in maps.items()}
assert peaks["without errors"] - peaks["with errors"] > 0.5
sharp = mended.spectrum(grid) / mended.spectrum(grid).max()
assert float((sharp - clean.spectrum / clean.spectrum.max()).abs().max()) < 0.02

# %% [markdown]
# On the command line: `invertwin look adc.bin … --reflector 2.2 0.5 0` writes `count_channels.json`, and `--channels
# channels.json` divides the gains out of another recording.
