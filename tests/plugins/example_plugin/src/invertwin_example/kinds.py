"""The classes and functions behind the kinds: plain users of the library."""

# Fields of a waveform may be properties of another.
# pyright: reportIncompatibleVariableOverride=false

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import torch
from annotated_types import Ge, Gt, Le

from invertwin.capture import Capture
from invertwin.limits import Angle, Positive
from invertwin.radar import FMCW, Radar, SampledWaveform
from invertwin.scene import AntennaArray, Material, Mesh, Object, ScatteringLaw, sphere


@dataclass(frozen=True)
class Foliage(Material):
    """Reflects the same share of the power at every angle, in all directions alike.

    Attributes:
        share: of the power.
    """

    share: Annotated[float | torch.Tensor, Gt(0), Le(1)]
    coherent: ClassVar[bool] = False

    def scattering_law(self, frequency: float) -> ScatteringLaw:
        share = torch.as_tensor(self.share, dtype=torch.float64)
        amplitude = share.sqrt() * torch.ones(256, dtype=torch.float64)
        return ScatteringLaw(amplitude, torch.ones((), dtype=torch.float64))


def bush(radius: Positive, lean: Angle = 0.0) -> Mesh:
    """A ball that leans to the left.

    Args:
        radius: m.
        lean: of its axis.
    """
    mesh = sphere(radius, 1)
    shift = torch.tensor([0.0, np.tan(lean), 0.0]) * mesh.vertices[:, 2:]
    return Mesh(mesh.vertices + shift, mesh.faces)


@dataclass(frozen=True)
class FallingRamp(SampledWaveform):
    """A chirp that sweeps down; its samples are sorted by frequency.

    Attributes:
        start_frequency: Hz, the lowest.
        bandwidth: Hz.
        duration: s.
        samples: of a ramp.
    """

    start_frequency: Positive
    bandwidth: Positive
    duration: Positive
    samples: Annotated[int, Ge(2)]

    @property
    def center_frequency(self) -> float:
        return self.start_frequency + self.bandwidth / 2

    @property
    def step(self) -> float:
        return self.bandwidth / self.samples

    @property
    def residual_slope(self) -> float:
        return -self.bandwidth / self.duration

    @property
    def noise_bandwidth(self) -> float:
        return self.samples / self.duration


class Thickness(torch.nn.Module):
    """How much a bush of foliage reflects; starts as it is in the scene."""

    def __init__(self, object: str, item: Object) -> None:
        """Find the share of `object`.

        Args:
            object: name in the scene.
            item: the object; an argument of this type is no key, run files hand it over.
        """
        super().__init__()
        self.object = object
        share = torch.as_tensor(item.material.share, dtype=torch.float64)
        self.logit = torch.nn.Parameter(torch.logit(share))

    def forward(self, scene):
        return scene.replace(self.object, material=Foliage(self.logit.sigmoid()))

    def values(self):
        return {f"{self.object}.share": self.logit.detach().sigmoid()}


@dataclass(frozen=True)
class LogLoss:
    """Squared difference of levels.

    Attributes:
        floor: over the mean measured power.
    """

    floor: Positive = 0.01

    def __call__(self, simulated, measured):
        floor = self.floor * measured.mean()
        # A predicted power can be slightly negative.
        levels = [(power.clamp_min(0.0) + floor).log() for power in (simulated, measured)]
        return (levels[0] - levels[1]).square().mean()


def npy(file: Path, bandwidth: Positive) -> Capture:
    """Samples of one antenna that stands at the origin, in a NumPy file.

    Args:
        file: [frame, sample], complex.
        bandwidth: Hz, of a ramp of 50 µs from 76 GHz.
    """
    samples = torch.from_numpy(np.load(file)).to(torch.complex128)
    antenna = AntennaArray(torch.zeros(1, 3, dtype=torch.float64))
    ramp = FMCW(76e9, bandwidth, 5e-5, samples.shape[1])
    places = torch.zeros(len(samples), 3, dtype=torch.float64)
    return Capture.from_beat(samples[:, None, None], Radar(antenna, antenna, ramp, places))
