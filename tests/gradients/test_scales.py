"""Maps and their derivatives of scenes from millimetres to kilometres."""

import pytest
import torch

import invertwin as iw
from invertwin.scene import AntennaArray, Mesh, RoughDielectric, box, linear_array, plate, rigid
from invertwin.scene.parameters import Pose

PAINT = RoughDielectric(4.0)
LEVEL = torch.tensor([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64)


def thing(mesh: Mesh, scale: float, place: tuple[float, float, float], turn=None) -> iw.Object:
    where = scale * torch.tensor(place, dtype=torch.float64)
    return iw.Object(Mesh(scale * mesh.vertices, mesh.faces), PAINT, rigid(turn, where))


def measure(scale: float, depth: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A box before a wall, on a floor if there is one bounce; wavelengths are scaled, too."""
    waveform = iw.FMCW(77e9 / scale, 3.6e9 / scale, 50e-6 * scale, 64)
    places = torch.zeros(3, 3, dtype=torch.float64)
    places[:, 1] = scale * torch.tensor([-0.5, 0.0, 0.5])
    transmitter = AntennaArray(torch.zeros(1, 3, dtype=torch.float64))
    radar = iw.Radar(transmitter, linear_array(8, waveform.wavelength / 2), waveform, places)
    things = {
        "box": thing(box((0.3, 0.4, 0.3)), scale, (1.3, 0.1, 0.0)),
        "wall": thing(plate(1.5, 1.0), scale, (1.9, 0.0, 0.0)),
    }
    if depth == 1:
        things["floor"] = thing(plate(3.0, 3.0), scale, (1.3, 0.0, -0.15), LEVEL)
    grid = radar.grid(0.8 * scale, 2.3 * scale, u_max=0.75)
    sampling = iw.Sampling(depth=depth, samples=20_000, boundary_samples=10_000)
    pose = Pose("box", axes="xy", rotation_axes="z")
    kernels = iw.Surrogate(range_width=2.0, angle_width=0.5)
    power = iw.SurrogateMap(grid, kernels, sampling).predict(pose(iw.Scene(things)), radar, 3)
    weights = torch.randn(power.shape, generator=torch.manual_seed(1)).to(power)
    ((power * weights).mean() / power.detach().mean()).backward()
    slopes = torch.cat([(p.grad if p.grad is not None else 0 * p) for p in pose.parameters()])
    return power.detach().double(), slopes.double()


@pytest.mark.parametrize("depth", [1, 2])
def test_no_length_of_our_own_is_in_the_kernels(depth):
    power, slopes = measure(1.0, depth)
    assert slopes.count_nonzero() >= 3
    bright = power > 1e-6 * power.max()
    for scale in (1e-3, 1e3):
        other, turned = measure(scale, depth)
        assert (other / power - 1)[bright].abs().max() < 1e-4
        turned[:3] *= scale
        assert (turned - slopes).abs().max() < 1e-4 * slopes.abs().max()
