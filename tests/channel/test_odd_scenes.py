"""Views of nothing, antennas in odd places, and gradients that must stay finite."""

import math
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as functional

from invertwin.channel import (
    Grid,
    Sampling,
    backend,
    deposit_power,
    trace_field,
    trace_power,
    use_backend,
)
from invertwin.errors import InputError
from invertwin.scene import (
    Cosine,
    Mesh,
    Object,
    PerfectConductor,
    RoughDielectric,
    Scene,
    plate,
    rigid,
    rotation_from_vector,
    sphere,
)
from invertwin_studies.recordings import rail_sar
from scenes import GRID, float64, link, occluder, shift_error, thing

COUNTS = Sampling(depth=1, samples=2_000, boundary_samples=500)
BACK = rotation_from_vector(float64([0.0, 0.0, math.pi]))[None]


def movable(scene: Scene) -> tuple[Scene, dict[str, torch.Tensor]]:
    leaves = {name: item.vertices.clone().requires_grad_() for name, item in scene.objects.items()}
    objects = {
        name: Object(Mesh(leaves[name], item.mesh.faces), item.material)
        for name, item in scene.objects.items()
    }
    return Scene(objects), leaves


@pytest.mark.parametrize(
    ("scene", "antennas"),
    [
        (occluder(), link(rotations=BACK, pattern=Cosine(1.0))),
        (occluder(), link(((-50.0, 0.0, 0.0),))),
        (Scene({"plate": thing(plate(1.0, 1.0), (2, 0, 0), (0.0, 0.0, math.pi / 2))}), link()),
        (
            Scene({"plate": thing(plate(1.0, 1.0), (0.0, 0.0, 0.0))}),
            link(((-1.0, 0.0, 0.0),), ((1.0, 0.0, 0.0),)),
        ),
    ],
    ids=["target behind the radar", "beyond the grid", "edge-on", "antennas on opposite sides"],
)
def test_nothing_to_see_is_zeros(scene, antennas):
    scene, leaves = movable(scene)
    places = antennas.tx.clone().requires_grad_()
    out = deposit_power(scene, replace(antennas, tx=places), GRID, sampling=COUNTS, seed=0)
    assert not out.any()
    gradients = torch.autograd.grad(out.sum(), [*leaves.values(), places])
    assert not any(g.any() for g in gradients)


def test_paths_of_an_empty_view():
    scene = Scene({"plate": thing(plate(1.0, 1.0))})
    apart = link(((-1.0, 0.0, 0.0),), ((1.0, 0.0, 0.0),))
    assert not trace_power(scene, apart, sampling=COUNTS, seed=0).power.any()
    assert (
        len(
            trace_field(
                scene,
                apart,
                sampling=Sampling(
                    depth=1, samples=100_000, boundary_samples=0, points_per_m2=500.0
                ),
                seed=0,
            )
        )
        == 0
    )
    metal = scene.replace("plate", material=PerfectConductor())
    assert (
        len(
            trace_field(
                metal,
                apart,
                sampling=Sampling(depth=1, conductor_samples=100, boundary_samples=0),
                seed=0,
            )
        )
        == 0
    )


def test_inside_an_object_the_walls_are_seen():
    """Both sides of a triangle reflect: from inside a ball every ray lands."""
    ball = Scene({"ball": thing(sphere(1.0, subdivisions=4), material=RoughDielectric(4.0))})
    found = deposit_power(
        ball, link(), GRID, sampling=Sampling(depth=1, samples=20_000, boundary_samples=0), seed=0
    )
    beyond = deposit_power(
        ball,
        link(((-3.0, 0.0, 0.0),)),
        GRID,
        sampling=Sampling(depth=1, samples=20_000, boundary_samples=0),
        seed=0,
    )
    assert float(found.sum()) > float(beyond.sum()) > 0


def test_an_object_without_area_is_refused():
    point = Mesh(torch.zeros(3, 3, dtype=torch.float64), torch.tensor([[0, 1, 2]]))
    with pytest.raises(InputError, match="expected a triangle of positive area, got none"):
        deposit_power(Scene({"point": thing(point)}), link(), GRID, sampling=COUNTS, seed=0)


@pytest.mark.parametrize("radius", [0.01, 0.05])
def test_small_balls_from_a_rail_have_finite_gradients(radius):
    """Most rays miss, and some shadows graze: neither may leave a NaN."""
    places = torch.zeros(60, 3, dtype=torch.float64)
    places[:, 1] = torch.linspace(-2, 2, 60)
    grid = Grid(2.5, 0.075, 40, u_start=-0.8, u_step=0.1, u_count=17)
    scene = Scene(
        {
            "a": thing(sphere(radius, subdivisions=2), (3.0, 0.0, 0.1)),
            "b": thing(sphere(radius, subdivisions=2), (3.4, 0.2, 0.1)),
        }
    )
    for seed in range(8):
        moved, leaves = movable(scene)
        track = places.clone().requires_grad_()
        out = deposit_power(
            moved,
            link(track),
            grid,
            sampling=Sampling(depth=1, samples=6_000, boundary_samples=2_000),
            seed=seed,
        )
        gradients = torch.autograd.grad(out.sum(), [*leaves.values(), track])
        assert out.any()
        assert shift_error(gradients) < 1e-4, seed


def test_measured_track_has_the_gradients_of_points(data_folder):
    """Small balls are points: the power falls with R⁴. Seed 36 once gave NaN, from a boundary ray
    in the plane of the triangle that it met."""
    capture = rail_sar.read(data_folder / "rail_sar", clock_offset=9.216, range_bias=0.46257)
    survey, radar = capture.survey, capture.radar()
    assert survey is not None
    shift = float64([0.0, -0.6, -0.04]).requires_grad_()
    eye = torch.eye(3, dtype=torch.float64)
    ball, surface = sphere(0.05, subdivisions=2), RoughDielectric(5.0)
    places = survey[0], survey[1] + shift
    scene = Scene(
        {f"ball {i}": Object(ball, surface, rigid(eye, at)) for i, at in enumerate(places)}
    )
    grid, antennas = radar.grid(6.8, 10.2, oversample=4), radar.link()
    alone = Scene({"ball": Object(ball, surface, rigid(eye, places[1].detach()))})
    plenty = Sampling(depth=1, samples=200_000, boundary_samples=0)
    power = deposit_power(alone, antennas, grid, sampling=plenty, seed=5)
    # ∂(P R)/∂x = −3 P ∂R/∂x of every frame.
    away = functional.normalize(places[1].detach() - antennas.tx, dim=1)
    expected = -3 * (power.sum((1, 2, 3)).double()[:, None] * away).sum(0)
    for seed in (0, 36):
        out = deposit_power(
            scene,
            antennas,
            grid,
            sampling=Sampling(depth=1, samples=20_000, boundary_samples=2_000),
            seed=seed,
        )
        (gradient,) = torch.autograd.grad((out * grid.ranges[:, None, None]).sum(), shift)
        assert float((gradient - expected).norm() / expected.norm()) < 0.02


def test_backend_by_argument_and_by_environment(monkeypatch):
    with use_backend("cpu"):
        assert backend() == "cpu"
        with use_backend(None):
            assert backend() == "cpu"
    monkeypatch.setenv("INVERTWIN_BACKEND", "cpu")
    assert backend() == "cpu"
    monkeypatch.setenv("INVERTWIN_BACKEND", "gpu")
    with pytest.raises(InputError, match="correct the argument or INVERTWIN_BACKEND"):
        backend()
    monkeypatch.setenv("INVERTWIN_BACKEND", "auto")
    assert backend() in ("cpu", "cuda")


def test_cuda_where_there_is_none(monkeypatch):
    monkeypatch.setattr("invertwin.channel.rays.backend._cuda_found", lambda: False)
    with (
        pytest.raises(InputError, match="expected an NVIDIA GPU for backend 'cuda'"),
        use_backend("cuda"),
    ):
        pass
    assert backend() == "cpu"


def test_a_backward_pass_runs_where_its_forward_pass_ran(monkeypatch):
    """The choice is that of the call, not of whoever asks for the derivative later."""
    scene, leaves = movable(occluder())
    with use_backend("cpu"):
        out = deposit_power(scene, link(), GRID, sampling=COUNTS, seed=0)
    monkeypatch.setenv("INVERTWIN_BACKEND", "nowhere")
    found = torch.autograd.grad(out.sum(), list(leaves.values()))
    monkeypatch.undo()
    scene, leaves = movable(occluder())
    with use_backend("cpu"):
        out = deposit_power(scene, link(), GRID, sampling=COUNTS, seed=0)
        expected = torch.autograd.grad(out.sum(), list(leaves.values()))
    for mine, theirs in zip(found, expected, strict=True):
        # Sums by atomic additions come in another order.
        torch.testing.assert_close(mine, theirs, rtol=1e-3, atol=1e-5 * float(theirs.abs().max()))
