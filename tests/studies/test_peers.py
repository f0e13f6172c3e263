"""The peers compute what they claim, so that a comparison with them is fair."""

import pytest
import torch

from invertwin.channel import Sampling, deposit_power, draw_speckle, trace_power
from invertwin.errors import InputError
from invertwin.inversion.gradcheck.gradcheck import GradcheckSettings, gradcheck
from invertwin.models.radar import SurrogateMap
from invertwin.radar import FMCW, Radar
from invertwin.radar.surrogate.surrogate import Surrogate
from invertwin.scene import AntennaArray, Isotropic, Object, RoughDielectric, Scene
from invertwin.scene.antenna import planar_array
from invertwin.scene.parameters import Translation
from invertwin.scene.pose import compose, rigid, rotation_from_vector
from invertwin.scene.shapes import plate
from invertwin_studies.peers.binning import binned
from invertwin_studies.peers.edge_sampling import edge_sampling_derivative
from invertwin_studies.peers.music import MusicMap
from invertwin_studies.peers.sionna import sionna_derivative, sionna_version

ALONG = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


def slide(scene, radar, theta):
    """The plate moved along y by θ."""
    moved = compose(scene["plate"].transform, rigid(translation=ALONG * theta))
    return scene.replace("plate", pose=moved), radar


SURROGATE = Surrogate(range_kernel="gaussian")


def scene(turn=0.0):
    rough = RoughDielectric(permittivity=4.0)
    turned = rotation_from_vector(torch.tensor([0.0, 0.0, turn], dtype=torch.float64))
    return Scene(
        {
            "plate": Object(plate(0.4, 0.3, 2), rough, rigid(turned, (1.2, 0.05, 0.0))),
            "wall": Object(plate(2.0, 2.0, 2), rough, rigid(translation=(1.6, 0.0, 0.0))),
        }
    )


@pytest.fixture
def radar():
    one = AntennaArray(torch.zeros(1, 3, dtype=torch.float64), Isotropic())
    waveform = FMCW(76e9, 2e9, 5e-5, 64)
    place = torch.zeros(1, 3, dtype=torch.float64)
    return Radar(one, planar_array((8, 6), (1.9e-3, 1.9e-3)), waveform, place)


@pytest.fixture
def grid(radar):
    return radar.grid(0.9, 1.9, 0.5, 0.5)


def test_paths_in_bins_are_what_the_kernel_deposits(radar, grid):
    link = radar.link()
    paths = trace_power(
        scene(0.2),
        link,
        sampling=Sampling(depth=1, samples=20_000, boundary_samples=0, boundary=False),
        seed=3,
    )
    ray = torch.nn.functional.normalize(paths.first - link.tx[paths.frame], dim=1)
    found = binned(paths.frame, paths.power, paths.range, ray[:, 1], ray[:, 2], grid)
    expected = deposit_power(
        scene(0.2),
        link,
        grid,
        sampling=Sampling(depth=1, samples=20_000, boundary_samples=0, boundary=False),
        seed=3,
    )
    torch.testing.assert_close(
        found.float(), expected, rtol=1e-3, atol=1e-3 * float(expected.max())
    )


def distance(found, truth):
    return float((found - truth).abs().sum() / truth.abs().sum())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("turn", "least", "most"),
    [(0.0, 0.0, 0.02), pytest.param(0.35, 0.2, 2.0, marks=pytest.mark.claim)],
)
def test_edge_sampling_lacks_the_delay_and_nothing_else(radar, grid, turn, least, most):
    """A plate that slides in its own plane keeps the delay of every ray; a tilted one does not."""
    given = scene(turn)
    sampling = Sampling(depth=1, samples=400_000, boundary_samples=200_000)
    report = gradcheck(
        SurrogateMap(grid, SURROGATE, sampling),
        Translation("plate"),
        ALONG,
        scene=given,
        sensor=radar,
        settings=GradcheckSettings(repeats=1, difference_samples=400_000, max_pairs=4),
    )
    found = edge_sampling_derivative(
        given, radar, grid, slide, surrogate=SURROGATE, samples=50_000, edge_samples=100_000, seed=1
    )
    assert least < distance(found, report.gradient) < most
    assert distance(report.gradient, report.difference) < 0.02


def test_edge_sampling_refuses_what_it_cannot_do(radar, grid):
    def moved(scene, radar, theta):
        return scene, radar.transform_rigidly(torch.eye(3, dtype=torch.float64), ALONG * theta)

    with pytest.raises(InputError, match="moves the radar"):
        edge_sampling_derivative(
            scene(), radar, grid, moved, surrogate=SURROGATE, samples=10, edge_samples=10, seed=1
        )


def test_music_is_differentiated_as_a_whole(radar, grid):
    given = scene(0.35)
    drawn = Sampling(depth=1, points_per_m2=500.0)
    speckle = draw_speckle(given, radar.link(), drawn, 1)
    music = MusicMap(radar, grid, speckle, 3, (4, 3), 1)
    found = music.derivative(given, slide)
    # Steps far below a wavelength and so small that no point appears.
    assert distance(found, music.difference(given, slide, 1e-7)) < 1e-3
    # Over a wavelength the spectrum is another one.
    assert distance(found, music.difference(given, slide, 4e-3)) > 0.3


@pytest.mark.skipif(sionna_version() is None, reason="Sionna RT is not installed")
def test_sionna_leaves_nothing_of_the_geometry(radar, grid):
    found = sionna_derivative(
        scene(0.35), radar, grid, slide, surrogate=SURROGATE, samples=20_000, seed=1
    )
    assert found.shape == (1, *grid.shape)
    assert not torch.count_nonzero(found)
