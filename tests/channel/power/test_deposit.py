"""The fused deposit against its slow references, its own adjoint, and itself."""

import gc
import weakref
from dataclasses import replace
from typing import Any

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from invertwin.channel import Grid, Link, Sampling, deposit_power
from invertwin.channel.power import trace
from invertwin.channel.rays.scene_tables import flatten
from invertwin.errors import InputError
from invertwin.scene import (
    Cosine,
    Isotropic,
    Mesh,
    Object,
    RoughDielectric,
    Scene,
    Slab,
    TabulatedPattern,
    box,
    plate,
    rigid,
    rotation_from_vector,
    sphere,
)
from invertwin.scene.mesh import concatenate_meshes
from oracles import autodiff_deposit
from oracles.deposit_by_paths import deposit_by_paths
from scenes import GRID, float64, link, occluder, relative, thing

COUNTS = Sampling(depth=1, samples=20_000, boundary_samples=4_000)
BOX = Grid(
    0.4, 0.075, 34, u_start=-0.6, u_step=0.1, u_count=13, v_start=-0.6, v_step=0.2, v_count=7
)


def lopsided() -> TabulatedPattern:
    """A pattern that depends on both angles."""
    theta, phi = torch.linspace(0, 2.0, 9).double(), torch.linspace(-3, 3, 7).double()
    return TabulatedPattern(theta, phi, 2 + torch.cos(theta)[:, None] * torch.cos(phi - 0.4)[None])


def leaves(bistatic: bool) -> dict[str, Tensor]:
    """Everything that a map can be differentiated by, in two frames."""
    turns = [rotation_from_vector(float64(v)) for v in ([0.0, 0.05, 0.1], [0.2, 0.0, -0.1])]
    values = {
        "wall": occluder()["wall"].vertices,
        "occluder": occluder()["occluder"].vertices,
        "tx": float64([[0.0, 0.0, 0.0], [-0.1, 0.2, 0.1]]),
        "rotations": torch.stack(turns),
        "permittivity": float64(4.0),
        "conductivity": float64(0.5),
        "diffuse": float64(0.6),
        "lobe_width": float64(0.5),
    }
    if bistatic:
        values["rx"] = values["tx"] + float64([0.05, 0.3, 0.0])
    return {name: value.clone().requires_grad_() for name, value in values.items()}


def built(values: dict[str, Tensor]) -> tuple[Scene, Link]:
    """The scene and the link of the leaves."""
    material = RoughDielectric(
        values["permittivity"], values["conductivity"], values["diffuse"], values["lobe_width"]
    )
    scene = Scene(
        {
            name: Object(Mesh(values[name], occluder()[name].mesh.faces), material)
            for name in ("wall", "occluder")
        }
    )
    return scene, link(values["tx"], values.get("rx"), values["rotations"], lopsided())


def random_map(shape: tuple[int, ...]) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64)


@pytest.mark.parametrize("grid", [GRID, BOX], ids=["range-u", "range-u-v"])
@pytest.mark.parametrize("bistatic", [False, True], ids=["monostatic", "bistatic"])
def test_value_and_gradients_are_those_of_the_torch_reference(bistatic, grid):
    values = leaves(bistatic)
    scene, antennas = built(values)
    fused = deposit_power(scene, antennas, grid, sampling=COUNTS, seed=3)
    slow = deposit_by_paths(scene, antennas, grid, sampling=COUNTS, seed=3)
    assert relative(fused, slow) < 1e-5
    weights = random_map(slow.shape)
    found, truth = (
        torch.autograd.grad((weights * out).sum(), list(values.values())) for out in (fused, slow)
    )
    for name, a, b in zip(values, found, truth, strict=True):
        assert relative(a, b) < 1e-3, name


@pytest.mark.parametrize("bistatic", [False, True], ids=["monostatic", "bistatic"])
def test_hand_written_adjoint_is_that_of_autodiff(bistatic):
    values = leaves(bistatic)
    scene, antennas = built({k: v.detach() for k, v in values.items()})
    weights = random_map((2, *BOX.shape))
    truth = autodiff_deposit.gradients(
        scene, antennas, BOX, weights, samples=20_000, edges=4_000, seed=3
    )
    geometry = flatten(scene, antennas.wavelength)
    vertices = geometry.vertices.clone().requires_grad_()
    split = len(scene["wall"].mesh.vertices)
    moved = scene
    for name, part in (("wall", vertices[:split]), ("occluder", vertices[split:])):
        moved = moved.replace(name, mesh=Mesh(part, scene[name].mesh.faces))
    poses = {
        name: getattr(antennas, name).clone().requires_grad_() for name in ("tx", "rx", "rotations")
    }
    if not bistatic:
        poses["rx"] = poses["tx"]
    fused = deposit_power(moved, replace(antennas, **poses), BOX, sampling=COUNTS, seed=3)
    wanted = {"vertices": vertices, **poses}
    found = torch.autograd.grad((weights * fused).sum(), list(wanted.values()))
    for name, gradient in zip(wanted, found, strict=True):
        own = "tx" if name == "rx" and not bistatic else name
        assert relative(gradient, truth[own].double()) < 1e-4, name


@pytest.mark.parametrize("bistatic", [False, True], ids=["monostatic", "bistatic"])
def test_forward_and_reverse_mode_agree(bistatic):
    values = leaves(bistatic)
    scene, antennas = built(values)
    out = deposit_power(scene, antennas, GRID, sampling=COUNTS, seed=3)
    weights = random_map(out.shape)
    pulled = torch.autograd.grad((weights * out).sum(), list(values.values()))
    generator = torch.Generator().manual_seed(1)
    for (name, value), bar in zip(values.items(), pulled, strict=True):
        tangent = torch.randn(value.shape, generator=generator, dtype=torch.float64)
        with forward_ad.dual_level():
            # All carry derivatives, as in reverse mode: edges are drawn for what moves.
            dual = {
                k: forward_ad.make_dual(v.detach(), tangent if k == name else torch.zeros_like(v))
                for k, v in values.items()
            }
            pushed = forward_ad.unpack_dual(
                deposit_power(*built(dual), GRID, sampling=COUNTS, seed=3)
            ).tangent
        assert pushed is not None
        there, back = (weights * pushed).sum(), (bar * tangent).sum()
        size = (weights * pushed.abs()).sum()
        assert float((there - back).abs() / size) < 1e-5, name


def test_coinciding_antennas_may_move_apart():
    """Equal positions, but a derivative with respect to one of them alone."""
    place, found = float64([[0.0, 0.0, 0.0]]), []
    weights = random_map((1, *GRID.shape))
    for which in ("tx", "rx"):
        own = place.clone().requires_grad_()
        antennas = replace(link(place), **{which: own})
        maps = [
            deposit(occluder(), antennas, GRID, sampling=COUNTS, seed=3)
            for deposit in (deposit_power, deposit_by_paths)
        ]
        fused, slow = (torch.autograd.grad((weights * out).sum(), own)[0] for out in maps)
        assert relative(fused, slow) < 1e-3
        found.append(fused)
    assert relative(*found) > 0.1


@pytest.mark.parametrize("sampling", ["rays", "area"])
def test_chunks_change_nothing(sampling):
    values = leaves(bistatic=True)
    results = []
    for budget in (1e9, 40_000):
        out = deposit_power(
            *built(values),
            GRID,
            sampling=replace(COUNTS, memory_budget=budget),
            seed=3,
            scheme=sampling,
        )
        gradients = torch.autograd.grad(out.square().sum(), list(values.values()))
        results.append([out, *gradients])
    for whole, pieces in zip(*results, strict=True):
        assert relative(pieces, whole) < 1e-5


def test_a_seed_repeats_and_another_differs():
    first, again, other = (
        deposit_power(
            occluder(),
            link(),
            GRID,
            sampling=Sampling(depth=1, samples=20_000, boundary_samples=0),
            seed=seed,
        )
        for seed in (0, 0, 1)
    )
    assert relative(again, first) < 1e-6
    assert relative(other, first) > 1e-4


@pytest.mark.parametrize("rx", [None, ((0.0, 0.5, 0.0),)], ids=["monostatic", "bistatic"])
def test_area_sampling_is_ray_sampling(rx):
    rays, area = (
        torch.stack(
            [
                deposit_power(
                    occluder(),
                    link(rx=rx),
                    GRID,
                    sampling=Sampling(depth=1, samples=200_000, boundary_samples=0),
                    seed=seed,
                    scheme=sampling,
                )
                for seed in range(4)
            ]
        )
        for sampling in ("rays", "area")
    )
    error = (rays.var(0) + area.var(0)).div(4).sqrt().sum() / rays.mean(0).sum()
    assert error < 0.03
    assert relative(area.mean(0), rays.mean(0)) < 2 * error


def test_boundary_samples_leave_the_value_alone():
    plain, full, off = (
        deposit_power(
            occluder(),
            link(),
            GRID,
            sampling=Sampling(depth=1, samples=10_000, boundary_samples=n, boundary=on),
            seed=0,
        )
        for n, on in ((0, True), (5_000, True), (5_000, False))
    )
    assert relative(full, plain) < 1e-6
    assert relative(off, plain) < 1e-6


def test_one_frame_at_a_time_is_all_frames():
    positions = float64([[0.0, 0.0, 0.0], [0.0, 0.3, 0.0]])
    both = deposit_power(
        occluder(),
        link(positions),
        GRID,
        sampling=Sampling(depth=1, samples=400_000, boundary_samples=0),
        seed=0,
    )
    for frame in range(2):
        alone = deposit_power(
            occluder(),
            link(positions[frame : frame + 1]),
            GRID,
            sampling=Sampling(depth=1, samples=200_000, boundary_samples=0),
            seed=0,
        )
        assert relative(alone[0], both[frame]) < 0.01


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"samples": 0}, "samples of at least 1"),
        ({"boundary_samples": -1}, "boundary_samples of at least 0"),
        ({"depth": 0}, "expected depth of at least 1, got 0"),
        ({"points_per_m2": 0.0}, r"expected points_per_m2 in \(0, inf\), got 0"),
        ({"backend": "tpu"}, "expected backend 'cpu', 'cuda' or 'auto', got 'tpu'"),
    ],
)
def test_bad_options_are_named(options, message, unchecked):
    with pytest.raises(InputError, match=message):
        deposit_power(occluder(), link(), GRID, sampling=replace(COUNTS, **options), seed=3)


def test_a_bad_scheme_is_named(unchecked):
    with pytest.raises(InputError, match="expected scheme 'rays' or 'area', got 'photons'"):
        deposit_power(occluder(), link(), GRID, sampling=COUNTS, seed=3, scheme="photons")  # type: ignore[arg-type]


def test_a_reference_of_another_mesh_is_refused():
    other = (Scene({"ball": thing(sphere(0.1))}), link())
    with pytest.raises(InputError, match="expected a reference scene of"):
        deposit_power(
            occluder(), link(), GRID, sampling=COUNTS, seed=3, scheme="area", reference=other
        )


@pytest.mark.parametrize(
    ("tx", "rotations"), [(((0.0, 0.0),), None), (((float("nan"), 0.0, 0.0),), None)]
)
def test_bad_links_are_named(tx, rotations, unchecked):
    with pytest.raises(InputError, match="expected finite tx of shape"):
        link(tx, rotations=rotations)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"range_count": 0}, "expected range_count of at least 1, got 0"),
        ({"range_step": 0.0}, "expected range_step above 0, got 0"),
        ({"u_step": -1.0}, "expected u_step above 0, got -1"),
    ],
)
def test_bad_grids_are_named(bad: dict[str, Any], message: str):
    good = Grid(range_start=0.0, range_step=0.1, range_count=4)
    with pytest.raises(InputError, match=message):
        replace(good, **bad)


@pytest.mark.gpu
@pytest.mark.parametrize("bistatic", [False, True], ids=["monostatic", "bistatic"])
def test_cuda_is_cpu(bistatic):
    values = leaves(bistatic)
    results = []
    for backend in ("cpu", "cuda"):
        out = deposit_power(*built(values), GRID, sampling=replace(COUNTS, backend=backend), seed=3)
        results.append([out, *torch.autograd.grad(out.square().sum(), list(values.values()))])
    for cpu, cuda in zip(*results, strict=True):
        assert relative(cuda, cpu) < 1e-3


def test_a_plate_seen_through_a_cosine_pattern():
    """A pattern only weighs: two antennas of gain g give g² where the direction is one."""
    far = Scene({"plate": thing(plate(0.02, 0.02), (1.5, 0.6, 0.0))})
    sampling = Sampling(depth=1, samples=2_000, boundary_samples=0)
    grid = Grid(0.0, 4.0, 1)
    plain, weighted = (
        deposit_power(far, link(pattern=pattern), grid, sampling=sampling, seed=0)
        for pattern in (Isotropic(), Cosine(3.0))
    )
    cosine = 1.5 / (0.6**2 + 1.5**2) ** 0.5
    assert float(weighted / plain) == pytest.approx((8 * cosine**3) ** 2, rel=1e-3)


BLOCK, SCREEN = box((0.4, 0.4, 0.4)), plate(2.0, 2.0)  # no transform builds meshes


def pushed_aside(offset):
    """A map of a box before a wall, two bounces, by the box's offset and permittivity."""
    moved = Object(BLOCK, RoughDielectric(3 + offset[3]), rigid(translation=offset[:3]))
    wall = thing(SCREEN, (1.5, 0.0, 0.0))
    few = Sampling(depth=2, samples=20_000, boundary_samples=20_000)
    around = link(((-1.5, 0.0, 0.0),))
    return deposit_power(Scene({"w": wall, "b": moved}), around, GRID, sampling=few, seed=1)


def test_the_transforms_of_torch_func_give_the_same_derivatives():
    start = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    columns = torch.func.jacfwd(pushed_aside)(start)
    assert columns.shape == (*pushed_aside(start).shape, 4)
    along = torch.tensor([0.5, 0.3, -1.0, 0.2], dtype=torch.float64)
    pushed = torch.func.jvp(pushed_aside, (start,), (along,))[1]
    assert relative(columns @ along.float(), pushed) < 1e-4
    weights = torch.linspace(0, 1, columns[..., 0].numel()).reshape(pushed.shape)
    offset = start.clone().requires_grad_()
    (pushed_aside(offset) * weights).sum().backward()
    pulled = torch.func.grad(lambda offset: (pushed_aside(offset) * weights).sum())(start)
    rows = torch.func.jacrev(lambda o: torch.stack([(pushed_aside(o) * weights).sum()] * 2))(start)
    truth = (columns * weights[..., None]).double().flatten(0, -2).sum(0)
    assert offset.grad is not None
    for found in (offset.grad, pulled, rows[0], rows[1]):
        assert relative(found, truth) < 1e-3


@pytest.mark.parametrize("part", [slice(0, 3), slice(3, 4)], ids=["place", "material"])
def test_a_batch_of_scenes_says_what_to_do(part):
    def of(values):
        offset = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
        return pushed_aside(torch.cat([offset[: part.start], values, offset[part.stop :]]))

    with pytest.raises(InputError, match="predict_batch"):
        torch.func.vmap(of)(torch.ones(2, part.stop - part.start, dtype=torch.float64))


def test_a_call_leaves_nothing_to_the_garbage_collector(monkeypatch):
    """Records of paths are large; they go with the last reference to the map."""
    alive = []

    class Seen(trace.PowerTracer):
        def __init__(self, *given, **named):
            super().__init__(*given, **named)
            alive.append(weakref.ref(self))

    monkeypatch.setattr("invertwin.channel.power.trace.PowerTracer", Seen)
    shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    scene = Scene(
        {
            "box": thing(
                Mesh(box((0.3, 0.4, 0.5)).vertices + shift, box((0.3, 0.4, 0.5)).faces),
                (2.0, 0.1, 0.0),
            )
        }
    )
    gc.collect()
    gc.disable()
    try:
        sampling = Sampling(depth=2, samples=1000, boundary_samples=500)
        deposit_power(scene, link(), GRID, sampling=sampling, seed=1).sum().backward()
        assert shift.grad is not None
        assert [ref() for ref in alive] == [None]
    finally:
        gc.enable()


def test_derivatives_with_doubled_sheets_are_refused():
    """Both panes count at silhouettes behind them; values meet one of them."""
    glass, turn = Slab(6.0, thickness=0.004), torch.zeros(3).double().requires_grad_()
    pane = Object(concatenate_meshes([plate(1.0, 1.0), plate(0.5, 0.5, 2)]), glass)
    at = float64([2.0, 0.0, 0.0])
    for pose in (rigid(translation=at), rigid(rotation_from_vector(turn), at)):
        scene = Scene({"pane": replace(pane, pose=pose)})
        if not pose.requires_grad:
            deposit_power(scene, link(), GRID, sampling=COUNTS, seed=1)
            continue
        with pytest.raises(InputError, match="place of pane, got 10 triangles on others"):
            deposit_power(scene, link(), GRID, sampling=COUNTS, seed=1)


def test_sheets_within_others_are_refused():
    """Light passes a wall within another one twice; metal within hides itself."""
    inner = Mesh(box(0.3).vertices + float64([0.0, 0.2, 0.0]), box(0.3).faces)
    both, at = concatenate_meshes([box(0.4), inner]), float64([2.0, 0.0, 0.0])
    walls = Object(both, Slab(6.0, thickness=0.004), rigid(translation=at))
    with pytest.raises(InputError, match="place of walls, got closed parts that overlap or touch"):
        deposit_power(Scene({"walls": walls}), link(), GRID, sampling=COUNTS, seed=1)
    solid = replace(walls, material=RoughDielectric(4.0))
    assert deposit_power(Scene({"walls": solid}), link(), GRID, sampling=COUNTS, seed=1).sum() > 0
