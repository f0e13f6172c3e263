"""Links on a GPU: every public function of `invertwin.links` on tensors that claim to be there."""

from functools import cache

import pytest
import torch
from torch import Tensor

import invertwin.links as lk
from claimed_tensors import Case, DeviceTests, Move
from invertwin.channel import RayPaths, trace_paths
from invertwin.scene import AntennaArray, TabulatedPattern, linear_array
from invertwin.scene.polarisation import JonesTable
from scenes import complex128, float64, occluder

pytestmark = pytest.mark.fake_cuda
FREQUENCY = 3.5e9
SENDERS, RECEIVERS = float64([[0.0, 0.0, 0.0]]), float64([[1.5, 0.4, 0.1], [3.0, 0.1, 0.2]])
ARRAY = lk.AntennaMount(linear_array(2, 0.04))
TURNED = lk.AntennaMount(linear_array(2, 0.04), torch.eye(3).double().expand(2, 3, 3))
MEASURED = lk.AntennaMount(
    AntennaArray(
        torch.zeros(1, 3, dtype=torch.float64),
        TabulatedPattern.from_decibels((0.0, 1.0, 3.0), ((0.0,), (-3.0,), (-20.0,))),
        JonesTable(float64([0.0, 1.0]), float64([0.0]), complex128([[[1, 0.1]], [[0.5, 1j]]])),
    )
)
SETTINGS = lk.PropagationSettings(FREQUENCY, 20e6)


@cache
def paths() -> RayPaths:
    """Direct, reflected, transmitted and diffracted ones."""
    return trace_paths(occluder(), SENDERS, RECEIVERS, FREQUENCY, depth=1, edges=1, rays=None)


def directions() -> Tensor:
    return torch.nn.functional.normalize(RECEIVERS, dim=1)


def gain_gradient(move: Move) -> list[Tensor]:
    found = move(paths())
    field = found.coefficient.detach().clone().requires_grad_()
    object.__setattr__(found, "coefficient", field)
    lk.received_gain(found, 20e6).sum().backward()
    assert field.grad is not None
    return [field.grad]


CASES: dict[str, Case] = {
    "AntennaMount.element_advances": lambda move: ARRAY.element_advances(
        move(directions()), move(torch.zeros(2, dtype=torch.int64))
    ),
    "AntennaMount.element_slopes": lambda move: ARRAY.element_slopes(
        move(directions()),
        move(torch.zeros(2, dtype=torch.int64)),
        move(directions().roll(1, 1)),
        70.0,
        move(float64([0.1, 0.2])),
    ),
    "AntennaMount.element_weights": lambda move: MEASURED.element_weights(
        *move((directions(), torch.tensor([0, 0])))
    ),
    "PropagationSettings.path_moments": lambda move: SETTINGS.path_moments(
        move(paths()), move(SENDERS), move(RECEIVERS), lk.AntennaMount()
    ),
    "PropagationSettings.sum_moments": lambda move: SETTINGS.sum_moments(
        move(paths()), lk.Transmitters(SENDERS), move(RECEIVERS)
    ),
    "angle_spread": lambda move: lk.angle_spread(move(paths())),
    "delay_spread": lambda move: lk.delay_spread(move(paths())),
    "frequency_response": lambda move: lk.frequency_response(
        move(paths()), float64([3.4e9, 3.5e9]), tx=ARRAY, rx=TURNED
    ),
    "impulse_response": lambda move: lk.impulse_response(move(paths()), bandwidth=1e9, taps=4),
    "ofdm_channel": lambda move: lk.ofdm_channel(
        move(paths()), subcarriers=8, spacing=1e6, symbols=2
    ),
    "path_amplitudes": lambda move: lk.path_amplitudes(move(paths()), ARRAY, TURNED),
    "path_table": lambda move: torch.tensor(list(lk.path_table(move(paths())).encode())),
    "received_gain": lambda move: [
        *(lk.received_gain(move(paths()), band) for band in (None, 0.0, 20e6, 1e12)),
        *gain_gradient(move),
    ],
    "rician_factor": lambda move: lk.rician_factor(move(paths())),
}

ON_CPU = {"path_table": "text"}
RAYS = "traces rays through a scene, whose geometry is on the CPU"
PLACES = "places of receivers and panels, a few numbers on the CPU"
NO_CASE = {
    **dict.fromkeys(
        (
            *("PropagationSettings.frequency_responses", "PropagationSettings.gains_and_moments"),
            *("PropagationSettings.link_statistics", "PropagationSettings.diffuse_moments"),
            *("PropagationSettings.panel_and_diffuse_moments", "PropagationSettings.trace_links"),
            *("ReceiverLocations.link_statistics", "ReceiverPoints.link_statistics"),
            *("panel_paths", "panel_response"),
        ),
        RAYS,
    ),
    **dict.fromkeys(
        (
            *("ElementPhases.forward", "PanelPlacement.forward", "PanelPlacement.values"),
            *("MapMesh.find_cells", "MapMesh.sample_points", "MapMesh.surface"),
            *("MapPlane.find_cells", "MapPlane.horizontal", "MapPlane.sample_points"),
            *("MapPlane.surface", "Metasurface.focus", "ReceiverLocations.fixed_visibility"),
            *("ReceiverLocations.with_sample_count", "TransmitterPosition.at_bounds"),
            *("Reverberation.link_moments", "ReverberationParameters.coordinates"),
            *("ReverberationParameters.forward", "ReverberationParameters.values"),
            *("TransmitterPosition.coordinates", "TransmitterPosition.forward"),
            *("TransmitterPosition.values", "Transmitters.frames", "WallPath.locate"),
        ),
        PLACES,
    ),
    "ray_paths_from_sionna": "reads NumPy's arrays",
}


class TestDevices(DeviceTests):
    room, cases, no_case, on_cpu = "invertwin.links", CASES, NO_CASE, ON_CPU
