"""What passes: boards, which let through straight on, and bodies, which refract."""

import math
import os
import subprocess
import sys

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from invertwin.channel import Grid, Sampling, deposit_power, trace_power
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.scene import (
    Mesh,
    Object,
    RefractingBody,
    RoughConductor,
    Scene,
    Slab,
    box,
    plate,
    sphere,
)
from scenes import WAVELENGTH, float64, link, noise, thing

WHITE = RoughConductor(scattering=1.0)
FREQUENCY = SPEED_OF_LIGHT / WAVELENGTH


def table(values: Tensor, cosine: float) -> float:
    at = cosine * (len(values) - 1)
    low = min(int(at), len(values) - 2)
    return float(values[low] + (values[low + 1] - values[low]) * (at - low))


@pytest.mark.parametrize("angle", [0.0, 0.5])
def test_a_wall_behind_a_board_is_fainter_and_later(angle):
    """By T(θ)², and by twice the extra length of the path, which is once that of the range."""
    board = Slab(2.7, 0.05, thickness=0.0125)
    direction = float64([math.cos(angle), math.sin(angle), 0.0])
    wall = thing(plate(0.05, 0.05), (2 * direction).tolist(), material=WHITE)
    bare = Scene({"wall": wall})
    covered = Scene(
        {"wall": wall, "board": thing(plate(2.0, 2.0), (1.0, 0.0, 0.0), material=board)}
    )
    behind = Grid(1.9, 0.01, 40)
    maps = [
        deposit_power(
            s,
            link(),
            behind,
            sampling=Sampling(depth=1, samples=400_000, boundary_samples=0),
            seed=0,
        )
        .double()
        .ravel()
        for s in (bare, covered)
    ]
    ranges = [float((m * behind.ranges).sum() / m.sum()) for m in maps]
    surface = board.scattering_law(FREQUENCY)
    share = table(surface.transmittance, math.cos(angle))
    assert share < 0.9
    assert float(maps[1].sum() / maps[0].sum()) == pytest.approx(share**2, rel=0.01)
    extra = table(surface.extra_length, math.cos(angle))
    assert ranges[1] - ranges[0] == pytest.approx(extra, abs=3e-4)


def slopes(still: dict[str, Object], item: Object, depth: int, seeds: int) -> list[Tensor]:
    """Derivatives of a map as an object slides across, one a seed."""
    grid = Grid(0.5, 0.1, 40, u_start=-0.6, u_step=0.1, u_count=13)
    sampling = Sampling(depth=depth, samples=50_000, boundary_samples=10_000)
    found = []
    for seed in range(seeds):
        with forward_ad.dual_level():
            shift = forward_ad.make_dual(float64([0.0, 0.0, 0.0]), float64([0.0, 1.0, 0.0]))
            mesh = Mesh(item.mesh.vertices + shift, item.mesh.faces)
            moved = still | {"target": Object(mesh, item.material, item.pose)}
            out = deposit_power(Scene(moved), link(), grid, sampling=sampling, seed=seed)
            found.append(forward_ad.unpack_dual(out).tangent)
    return found


WALL = {"wall": thing(plate(4.0, 4.0), (3.0, 0.0, 0.0))}


def test_a_board_in_front_adds_little_noise():
    """What passes it is spread as evenly as what meets it; thrown dice would add 30 times more."""
    target = thing(plate(0.5, 0.4), (2.0, 0.1, 0.05), (0.0, 0.1, 0.2))
    board = thing(plate(3.0, 3.0), (1.0, 0.0, 0.0), (0.0, 0.0, 0.1), Slab(2.7, thickness=0.0125))
    bare, covered = (
        noise(slopes(still, target, 1, seeds=8)) for still in (WALL, WALL | {"board": board})
    )
    assert bare < 0.01
    assert covered < 3 * bare


@pytest.mark.slow
def test_objects_that_are_sheets_all_round_add_bounded_noise():
    """Against white ones: a box of its derivative, what is faint of that of the white one."""
    pane = Slab(2.7, thickness=0.0125, scattering=1.0)
    at = (2.0, 0.1, 0.05), (0.0, 0.1, 0.2)

    def ratios(shape: Mesh, depth: int) -> tuple[float, float]:
        hollow, full = (slopes(WALL, thing(shape, *at, m), depth, 16) for m in (pane, WHITE))
        spread = [float(torch.stack(found).std(0).sum()) for found in (hollow, full)]
        return noise(hollow) / noise(full), spread[0] / spread[1]

    assert ratios(box(0.5), 1)[0] < 2
    assert ratios(box(0.5), 2)[1] < 1.2
    assert ratios(sphere(0.3, 4), 1)[1] < 3


def block(index: float, thickness: float, near: float, slope: float, width: float) -> Object:
    """A box across the boresight, without losses."""
    body = RefractingBody(index**2, rms_slope=slope)
    return thing(box((thickness, width, width)), (near + thickness / 2, 0.0, 0.0), material=body)


INDEX, THICK, NEAR, FAR = 1.6, 0.2, 0.5, 0.5
PASSED = 1 - ((INDEX - 1) / (INDEX + 1)) ** 2  # through one face, straight on


def test_what_has_passed_a_body_is_late_and_spread_from_nearer():
    """One way: (n−1)d longer, and as strong as if the body were d/n thick."""

    def received(depth: float, *bodies: Object) -> tuple[float, float]:
        """Power and mean length by way of a wall that the receiver sees for itself."""
        wall = thing(plate(0.2, 0.2), (depth, 0.0, 0.0), material=WHITE)
        scene = Scene({"wall": wall} | {f"body {k}": item for k, item in enumerate(bodies)})
        antennas = link(((0.0, 0.0, 0.0),), ((depth - 0.3, 0.0, 0.3),))
        paths = trace_power(
            scene,
            antennas,
            sampling=Sampling(
                depth=3 if bodies else 1, samples=1_000_000, boundary_samples=0, boundary=False
            ),
            seed=1,
        )
        on = (paths.last[:, 0] - depth).abs() < 1e-6
        if bodies:
            on &= (paths.first[:, 0] - NEAR).abs() < 1e-6
        power = paths.power[on]
        return float(power.sum()), float((power * 2 * paths.range[on]).sum() / power.sum())

    item = block(INDEX, THICK, NEAR, slope=0.02, width=0.8)
    power, length = received(NEAR + THICK + FAR, item)
    spread, _ = received(NEAR + THICK / INDEX + FAR)
    _, straight = received(NEAR + THICK + FAR)
    assert power / spread == pytest.approx(PASSED**2, rel=0.03)
    assert length - straight == pytest.approx((INDEX - 1) * THICK, abs=0.004)


@pytest.mark.claim
@pytest.mark.slow
def test_a_wall_is_seen_through_a_body_and_back():
    """The echo of five points: (n−1)d further away, and as strong as one from d − d/n nearer."""

    def echo(depth: float, **bodies: Object) -> tuple[Tensor, Tensor]:
        """Power of every seed, and its mean distance."""
        wall = thing(plate(0.3, 0.3), (depth, 0.0, 0.0), material=WHITE)
        scene, grid = Scene({"wall": wall, **bodies}), Grid(depth - 0.03, 0.01, 30)
        maps = [
            deposit_power(
                scene,
                link(),
                grid,
                sampling=Sampling(depth=5, samples=1_000_000, boundary_samples=0),
                seed=seed,
            )
            for seed in range(8)
        ]
        found = torch.stack(maps).double().reshape(8, -1)
        return found.sum(1), (found.sum(0) * grid.ranges).sum() / found.sum()

    item = block(INDEX, THICK, NEAR, slope=0.03, width=0.5)
    power, distance = echo(NEAR + THICK + FAR, body=item)
    spread, _ = echo(NEAR + THICK / INDEX + FAR)
    _, straight = echo(NEAR + THICK + FAR)
    ratio = power / spread.mean() / PASSED**4
    error = float(ratio.std()) / 8**0.5
    assert error < 0.08
    assert abs(float(ratio.mean()) - 1) < 4 * error
    # The faces' roughness lengthens the path by some millimetres.
    assert float(distance - straight) == pytest.approx((INDEX - 1) * THICK, abs=0.006)


def leaving(index: float) -> Tensor:
    """What enters a box by its front and leaves it by the face at its left."""
    body = RefractingBody(index**2, rms_slope=0.05)
    scene = Scene({"body": thing(box(0.4), (1.0, 0.0, 0.0), material=body)})
    antennas = link(((0.0, -1.0, 0.0),), ((1.9, 0.6, 0.0),))
    paths = trace_power(
        scene,
        antennas,
        sampling=Sampling(depth=2, samples=400_000, boundary_samples=0, boundary=False),
        seed=0,
    )
    rows = ((paths.first[:, 0] - 0.8).abs() < 1e-6) & ((paths.last[:, 1] - 0.2).abs() < 1e-6)
    return paths.power[rows]


def test_beyond_the_critical_angle_nothing_leaves():
    """By the face beside the one it entered by, something leaves only if n < √2."""
    left = float(leaving(1.2).sum())
    assert left > 0
    assert float(leaving(2.0).sum()) < 1e-6 * left


def test_refraction_shifts_a_ray_as_snell_says():
    """Where paths meet the wall, against Snell's law from where they entered."""
    thickness, near, far = 0.2, 0.8, 0.4
    wall = thing(plate(2.0, 1.0), (near + thickness + far, 0.7, 0.0), material=WHITE)
    scene = Scene({"body": block(INDEX, thickness, near, slope=0.03, width=3.0), "wall": wall})
    rx = float64([near + thickness + 0.05, 0.7, 0.0])
    antennas = link(((0.0, 0.0, 0.0),), rx[None])
    paths = trace_power(
        scene,
        antennas,
        sampling=Sampling(depth=3, samples=400_000, boundary_samples=0, boundary=False),
        seed=0,
    )
    on = (paths.first[:, 0] - near).abs() < 1e-6
    on &= (paths.last[:, 0] - near - thickness - far).abs() < 1e-6
    first, last = paths.first[on], paths.last[on]
    # Without what the receiver's place favours.
    to_rx = rx - last
    weight = paths.power[on] * to_rx.square().sum(1) ** 1.5 / -to_rx[:, 0]
    inwards = torch.nn.functional.normalize(first, dim=1)
    within = inwards[:, 1:] / INDEX
    within = within / (1 - within.square().sum(1, keepdim=True)).sqrt()
    bent = first[:, 1:] + thickness * within + far * inwards[:, 1:] / inwards[:, :1]
    straight = first[:, 1:] + (thickness + far) * inwards[:, 1:] / inwards[:, :1]
    oblique = (inwards[:, 0] > 0.75) & (inwards[:, 0] < 0.9)
    side = torch.nn.functional.normalize(first[:, 1:], dim=1)
    gaps = [
        float((((last[:, 1:] - p) * side).sum(1) * weight)[oblique].sum() / weight[oblique].sum())
        for p in (bent, straight)
    ]
    assert abs(gaps[0]) < 0.005
    assert gaps[1] < -0.05


FIRST_OF_A_PROCESS = """
import sys
from invertwin.channel import Grid, Sampling, deposit_power
from invertwin.scene import RoughConductor, Scene, Slab, plate
from scenes import link, thing

white = RoughConductor(scattering=1.0)
wall = thing(plate(0.5, 0.5), (2.0, 0.0, 0.0), material=white)
board = thing(plate(0.6, 0.6), (1.0, 0.0, 0.0), material=Slab(2.7, 0.05, thickness=0.0125))
found = deposit_power(
    Scene({"wall": wall, "board": board}), link(), Grid(1.8, 0.05, 12),  # without the board
    sampling=Sampling(depth=2, samples=100_000, boundary_samples=0), seed=0, scheme=sys.argv[1],
)
print(float(found.double().sum()))
"""


@pytest.mark.slow
def test_the_tree_is_there_before_a_loop_is_recorded(repository):
    """To build it inside aborts the process; only the first call of a process would build it."""
    folders = ":".join(str(repository / name) for name in ("src", "tests"))
    environment = {**os.environ, "PYTHONPATH": folders}
    found = [
        subprocess.run(
            [sys.executable, "-c", FIRST_OF_A_PROCESS, scheme],
            env=environment, check=True, capture_output=True, text=True,
        ).stdout
        for scheme in ("area", "rays")
    ]  # fmt: skip
    assert float(found[0]) == pytest.approx(float(found[1]), rel=0.02)
    assert float(found[1]) > 0


def test_all_loops_over_rays_are_made_where_the_tree_is_built(repository):
    users = [p.name for p in (repository / "src").rglob("*.py") if "while_loop(" in p.read_text()]
    assert users == ["ray_scene.py"]
