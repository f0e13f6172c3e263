"""Fields from behind a sheet have the power and the delay that power paths have."""

import pytest
import torch

from invertwin.channel import Sampling, trace_field, trace_power
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.scene import (
    Mesh,
    Object,
    PerfectConductor,
    RoughDielectric,
    Scene,
    Slab,
    plate,
    rigid,
)
from scenes import link


def test_fields_pass_sheets_as_power_does():
    sheet = Slab(permittivity=2.5, conductivity=0.1, thickness=0.02)
    board = Object(plate(2.0, 2.0), sheet, rigid(translation=[1.0, 0.0, 0.0]))
    target = Object(plate(0.4, 0.4), RoughDielectric(4.0), rigid(translation=[2.0, 0.0, 0.0]))
    scene = Scene({"board": board, "target": target})
    antennas = link(((0.0, 0.0, 0.0),))
    with torch.no_grad():
        field = trace_field(
            scene,
            antennas,
            sampling=Sampling(
                depth=1, conductor_samples=100_000, boundary_samples=0, points_per_m2=1e4
            ),
            seed=1,
        )
        power = trace_power(
            scene,
            antennas,
            sampling=Sampling(depth=1, samples=200_000, boundary_samples=0, boundary=False),
            seed=1,
        )
    behind = [paths.delay * SPEED_OF_LIGHT / 2 > 1.8 for paths in (field, power)]
    received = field.coefficient[behind[0]].abs().square().sum()
    assert float(received) == pytest.approx(float(power.power[behind[1]].sum()), rel=0.05)
    late = [float(paths.delay[b].min()) for paths, b in zip((field, power), behind, strict=True)]
    assert late[0] == pytest.approx(late[1], rel=1e-3)


def test_a_moving_silhouette_of_a_coherent_field_past_a_sheet_is_refused():
    board = Object(plate(2.0, 2.0), Slab(2.5, thickness=0.02), rigid(translation=[1.0, 0.0, 0.0]))
    mesh = plate(0.4, 0.4)
    vertices = (mesh.vertices + torch.tensor([2.0, 0.0, 0.0])).requires_grad_()
    mirror = Object(Mesh(vertices, mesh.faces), PerfectConductor())
    with pytest.raises(InputError, match="expected no sheets where a derivative of coherent"):
        trace_field(
            Scene({"board": board, "mirror": mirror}),
            link(),
            sampling=Sampling(depth=1, conductor_samples=100_000, boundary_samples=100),
            seed=1,
        )
