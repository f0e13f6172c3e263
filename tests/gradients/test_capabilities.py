"""The capability table, cell by cell."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor, nn
from torch.func import functional_call

from gradients.capability_table import CELLS, MECHANISMS
from invertwin.camera import Camera, ImageSampling
from invertwin.capture import Capture
from invertwin.capture.track import Track
from invertwin.channel import (
    Link,
    Paths,
    RayPaths,
    Sampling,
    combine_coherently,
    deposit_paths,
    deposit_power,
    trace_facet_paths,
    trace_field,
    trace_paths,
    trace_single_scattering,
    trace_target,
)
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.inversion.gradcheck.gradcheck import GradcheckSettings, gradcheck
from invertwin.inversion.gradcheck.lines import make_line
from invertwin.links import CellSampling, MapPlane, PropagationSettings, Reverberation, Transmitters
from invertwin.links.metasurface.panel import Metasurface, panel_response
from invertwin.models.camera import DepthMap, SilhouetteMap
from invertwin.models.radar import SurrogateMap
from invertwin.radar import FMCW, Radar, Surrogate, beat_signal, exact_spectrum, surrogate_spectrum
from invertwin.radar.parameters import ClockOffset, RadarPose, RangeBias
from invertwin.scene import (
    AntennaArray,
    Cosine,
    DensityGrid,
    Dielectric,
    Material,
    PerfectConductor,
    RoughDielectric,
    Scene,
    Slab,
    TabulatedPattern,
    linear_array,
    plate,
    rotation_from_vector,
)
from invertwin.scene.parameters import (
    MaterialValues,
    Pose,
    Scale,
    Translation,
    Vertices,
)
from invertwin.signatures import rcs
from scenes import float64, occluder, relative, thing

ROUGH = RoughDielectric(4.0, 0.5, 0.6, 0.5)
METAL = PerfectConductor()
COATED = Dielectric(4.0, 0.5, scattering=0.6, rms_slope=0.4)
BOARD = Slab(2.7, 0.05, thickness=3e-3, scattering=0.8, rms_slope=0.4)


def power_radar(positions: object = ((0.0, 0.0, 0.0),)) -> Radar:
    """77 GHz, 16 elements in a row, a pattern that depends on direction."""
    return Radar(
        AntennaArray(torch.zeros(1, 3, dtype=torch.float64), Cosine(2.0)),
        linear_array(16, 1.9467e-3, pattern=Cosine(2.0)),
        FMCW(76e9, 2e9, 50e-6, 64),
        float64(positions),
        array_window="rectangular",
    )


def field_radar(wavelength: float) -> Radar:
    """Four places of one antenna, at a long wave so that few samples resolve the fringes."""
    middle = SPEED_OF_LIGHT / wavelength
    one = AntennaArray(torch.zeros(1, 3, dtype=torch.float64), Cosine(2.0))
    places = [[0.0, -0.3, -0.1], [0.0, 0.3, -0.1], [0.0, -0.3, 0.1], [0.0, 0.3, 0.1]]
    return Radar(one, one, FMCW(middle - 0.5e9, 1e9, 50e-6, 32), float64(places))


@dataclass(frozen=True)
class Move:
    """What θ changes: a parameter of a module of the scene or the radar, along a tangent."""

    module: nn.Module
    tangent: dict[str, Tensor]
    of: Literal["scene", "sensor"] = "scene"
    wall: Material | None = None  # in place of the scene's

    def start(self, scene: Scene) -> Scene:
        return scene if self.wall is None else scene.replace("wall", material=self.wall)

    def __call__(self, scene: Scene, radar: Radar, theta: Tensor) -> tuple[Scene, Radar]:
        scene = self.start(scene)
        if self.of == "scene":
            return make_line(self.module, self.tangent, scene).evaluate(theta), radar
        return scene, make_line(self.module, self.tangent, radar).evaluate(theta)


def material(name: str, start: float, wall: Material | None = None) -> Move:
    """A value of the wall's material, which is another one if ``wall`` is given."""
    values: dict[str, Any] = {name: start}
    module = MaterialValues("wall", **values)
    return Move(module, {f"raw.{name}": float64(1.0)}, wall=wall)


def soft() -> Move:
    """The occluder as a soft ball, whose densities change at random."""
    reach = [0.3, 0.3, 0.3]
    nodes = DensityGrid.from_optical_depth(
        "occluder", [-x for x in reach], reach, (9, 9, 9)
    ).lattice.nodes
    ball = 15 * torch.sigmoid((0.2 - nodes.norm(dim=-1)) / 0.03)
    change = torch.randn(ball.shape, generator=torch.Generator().manual_seed(2)).double()
    return Move(DensityGrid("occluder", [-x for x in reach], reach, ball), {"value": change})


CORNERS = float64([[0.0, 1.0, 0.0], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0], [0.3, 0.0, 0.0]])
ASIDE = {"translation": float64([0.1, 0.9, 0.3])}
GEOMETRY = {"translation", "pose", "scale", "vertices"}
MOVES: dict[str, Move] = {
    "translation": Move(Translation("occluder"), ASIDE),
    "pose": Move(Pose("occluder"), {"rotation": float64([0.6, 0.2, 0.9])}),
    "scale": Move(Scale("occluder"), {"log_scale": float64(1.0)}),
    "vertices": Move(Vertices("occluder", 4), {"offsets": CORNERS}),
    "radar position": Move(RadarPose(), ASIDE, "sensor"),
    "radar rotation": Move(RadarPose(), {"rotation": float64([0.1, 0.2, 0.9])}, "sensor"),
    "permittivity": material("permittivity", 4.0),
    # As lossy as it is dense, so that the derivative is no small difference of two angles.
    "conductivity": material("conductivity", 10.0),
    "diffuse fraction": material("diffuse", 0.6),
    "lobe width": material("lobe_width", 0.5),
    "thickness": material("thickness", 3e-3, BOARD),
    "roughness": material("rms_slope", 0.4, COATED),
    "scattering coefficient": material("scattering", 0.6, COATED),
    "depolarisation": material("depolarisation", 0.1),
    "density": soft(),
}


def clock() -> tuple[Radar, Move]:
    """A radar on a track, and the module that shifts its clock."""
    times = torch.linspace(0, 1, 3, dtype=torch.float64)
    path = float64([[0.0, -0.5, 0.0], [0.1, 0.5, 0.1]])
    track = Track(float64([-0.5, 1.5]), path)
    radar = power_radar(track.interpolate(times).tolist())
    single = replace(radar, receivers=radar.transmitters)
    profile = torch.ones(3, 8, dtype=torch.complex128)
    capture = Capture.from_range_profile(
        profile, torch.arange(8).double() * 0.1 + 1, single, times, track=track
    )
    return radar, Move(ClockOffset(capture.positions), {"shift": float64(1.0)}, "sensor")


@dataclass(frozen=True)
class Found:
    """Derivatives of one power map."""

    full: Tensor
    interior: Tensor
    truth: Tensor
    noise: float


def power_case(parameter: str) -> Found:
    scene = occluder(wall=ROUGH, occluder=ROUGH)
    radar, move = clock() if parameter == "clock offset" else (power_radar(), MOVES[parameter])
    model = SurrogateMap(
        radar.grid(0.4, 2.8, 0.6, oversample=1),
        Surrogate("gaussian", range_width=2.0, angle_width=1.0),
        Sampling(
            depth=1,
            samples=200_000 * radar.frame_count,
            boundary_samples=50_000 * radar.frame_count,
        ),
    )
    check = GradcheckSettings(
        repeats=2,
        difference_samples=300_000 * radar.frame_count,
        noise=0.01,
        max_pairs=16,
    )
    report = gradcheck(
        model,
        move.module,
        move.tangent,
        scene=move.start(scene),
        sensor=radar,
        acts_on=move.of,
        settings=check,
    )
    return Found(
        report.gradient, report.interior_gradient, report.difference, report.difference_noise
    )


def biased(theta: Tensor, scene: Scene, seed: int, boundary: bool, depth: int = 1) -> Tensor:
    radar = functional_call(RangeBias(), {"bias": theta}, (power_radar(),))
    return surrogate_spectrum(
        scene,
        radar,
        radar.grid(0.4, 2.8, 0.6, oversample=1),
        Surrogate(),
        sampling=Sampling(depth=depth, samples=50_000, boundary_samples=0, boundary=boundary),
        seed=seed,
    ).double()


def bias_case(depth: int = 1) -> Found:
    """The bias moves the map itself, so that one seed suffices."""
    scene, zero = occluder(wall=ROUGH, occluder=ROUGH), torch.zeros((), dtype=torch.float64)
    maps = [biased(zero + sign * 1e-4, scene, 0, True, depth) for sign in (1, -1)]
    both = [pushed(lambda theta, on=on: biased(theta, scene, 0, on, depth)) for on in (True, False)]
    return Found(both[0], both[1], (maps[0] - maps[1]) / 2e-4, 0.0)


def pushed(function: Callable[[Tensor], Tensor]) -> Tensor:
    """Forward-mode derivative at θ = 0, zeros where nothing depends on θ."""
    with forward_ad.dual_level():
        theta = forward_ad.make_dual(
            torch.zeros((), dtype=torch.float64), torch.ones((), dtype=torch.float64)
        )
        value, tangent = forward_ad.unpack_dual(function(theta))
        return torch.zeros_like(value) if tangent is None else tangent


def response(scene: Scene, radar: Radar, sampling: Sampling, seed: int) -> Tensor:
    """Real and imaginary parts of the channel at the carrier, per frame."""
    antennas = radar.link()
    return at_carrier(trace_field(scene, antennas, sampling=sampling, seed=seed), antennas)


def at_carrier(paths: Paths, antennas: Link) -> Tensor:
    """Real and imaginary parts of the sum of field paths, per frame."""
    phase = 2 * math.pi / antennas.wavelength * SPEED_OF_LIGHT * paths.delay
    field = paths.coefficient * torch.polar(torch.ones_like(phase), -phase)
    total = torch.zeros(antennas.frame_count, dtype=torch.complex128)
    return torch.view_as_real(total.index_add(0, paths.frame, field))


def coherent_case(parameter: str) -> Found:
    scene, radar, moves = occluder(wall=METAL, occluder=METAL), field_radar(0.3), MOVES[parameter]
    # A growing object has other areas, hence other samples: take a larger step.
    step, pairs = 6e-2 if parameter == "scale" else 2e-2, 8

    def value(theta: Tensor, seed: int, boundary: bool, samples: int, edges: int) -> Tensor:
        return response(
            *moves(scene, radar, theta),
            Sampling(depth=1, conductor_samples=samples, boundary_samples=edges, boundary=boundary),
            seed,
        )

    def derivative(boundary: bool) -> Tensor:
        return torch.stack(
            [pushed(lambda t, s=s: value(t, s, boundary, 60_000, 20_000)) for s in range(2)]
        ).mean(0)

    ends = [
        [value(torch.tensor(sign * step).double(), 9 + k, False, 60_000, 0) for sign in (1, -1)]
        for k in range(pairs)
    ]
    differences = torch.stack([(up - down) / (2 * step) for up, down in ends])
    truth = differences.mean(0)
    noise = differences.std(0).div(math.sqrt(pairs)).sum() / truth.abs().sum().clamp_min(1e-300)
    return Found(derivative(True), derivative(False), truth, float(noise))


def rough_case(parameter: str) -> Found:
    """Fixed points: differences are as smooth as the derivative."""
    scene, radar, moves = occluder(wall=ROUGH, occluder=ROUGH), field_radar(0.3), MOVES[parameter]

    def value(theta: Tensor) -> Tensor:
        drawn = Sampling(depth=1, boundary_samples=0, points_per_m2=300.0)
        return response(*moves(scene, radar, theta), drawn, 0)

    up, down = (value(torch.tensor(sign * 1e-4).double()) for sign in (1, -1))
    found = pushed(value)
    return Found(found, found, (up - down) / 2e-4, 0.0)


def section(scene: Scene) -> Tensor:
    """Radar cross-sections from in front, a little to the side."""
    sides = float64([[-1.0, 0.3, 0.1], [-1.0, 0.05, -0.2]])
    return rcs(scene, sides, [1e9], edges=0).cross_section


def signature_case(parameter: str) -> Found:
    """Without random numbers, differences are as smooth as the derivative."""
    wall = METAL if parameter in GEOMETRY else COATED
    scene, moves = occluder(wall=wall, occluder=METAL), MOVES[parameter]

    def value(theta: Tensor) -> Tensor:
        return section(moves(scene, power_radar(), theta)[0])

    up, down = (value(torch.tensor(sign * 1e-5).double()) for sign in (1, -1))
    found = pushed(value)
    return Found(found, found, (up - down) / 2e-5, 0.0)


def between(scene: Scene, place: Tensor) -> Tensor:
    """Response and Doppler shifts between two antennas, which wall and occluder mirror."""
    ends = place + float64([0.19, -0.07, 0.74]), [0.07, -0.09, -0.46]
    paths = trace_paths(scene, *ends, 1e9, rays=4000)
    assert len(paths) == 3  # the line of sight, and one mirror each
    turn = torch.polar(torch.ones_like(paths.delay), -2e9 * math.pi * paths.delay)
    field = (paths.coefficient * turn[:, None, None]).sum(0)
    return torch.cat([torch.view_as_real(field).flatten(), paths.doppler])


def antenna_case(parameter: str) -> Found:
    """Differences are as smooth as the derivative, since no path appears or vanishes."""
    wall = METAL if parameter in GEOMETRY else COATED
    scene, radar = occluder(wall=wall, occluder=METAL), power_radar()

    def value(theta: Tensor) -> Tensor:
        if parameter == "object velocity":
            speed = theta * float64([1.0, 0.3, 0.2])
            return between(scene.replace("wall", velocity=speed), radar.positions[0])
        changed = MOVES[parameter](scene, radar, theta)
        return between(changed[0], changed[1].positions[0])

    up, down = (value(torch.tensor(sign * 1e-5).double()) for sign in (1, -1))
    found = pushed(value)
    return Found(found, found, (up - down) / 2e-5, 0.0)


# Cells between occluder and wall, where the occluder's shadow lies.
CELLS_BEHIND = MapPlane(
    float64([1.7, -0.47, -0.55]), float64([0, 1.2, 0]), float64([0, 0, 1.2]), (2, 2)
)


def covered(
    scene: Scene,
    place: Tensor,
    sampling: CellSampling,
    seed: int = 0,
    tail: Reverberation | None = None,
) -> Tensor:
    """Mean power in cells, seen directly and by the mirror of the wall."""
    cells = replace(CELLS_BEHIND, sampling=sampling)
    mast = Transmitters(place + float64([0.19, -0.07, 0.04]), reverberation=tail)
    return cells.link_statistics(
        scene, mast, PropagationSettings(1e9, depth=1, rays=None), seed
    ).gain


def coverage_case(parameter: str) -> Found:
    wall = METAL if parameter in GEOMETRY else COATED
    scene, radar = occluder(wall=wall, occluder=METAL), power_radar()
    if parameter == "thickness":
        scene = scene.replace("wall", material=BOARD)

    def value(theta: Tensor, sampling: CellSampling, seed: int = 0) -> Tensor:
        if parameter == "object velocity":
            moved = scene.replace("wall", velocity=theta * float64([1.0, 0.3, 0.2]))
            return covered(moved, radar.positions[0], sampling, seed)
        if parameter == "reverberant tail":
            tail = Reverberation(-55.0 + theta, 20e-9 * (1 + theta))
            return covered(scene, radar.positions[0], sampling, seed, tail)
        changed = MOVES[parameter](scene, radar, theta)
        return covered(changed[0], changed[1].positions[0], sampling, seed)

    # Where no shadow moves, few points are as smooth as their derivative.
    moves = parameter in GEOMETRY or parameter == "radar position"
    step, side, seeds = (0.02, 120, 3) if moves else (1e-4, 20, 1)
    fine, parts = CellSampling(side**2), []
    for seed in range(seeds):
        ends = [value(torch.tensor(sign * step).double(), fine, seed) for sign in (1, -1)]
        parts.append((ends[0] - ends[1]) / (2 * step))
    own = CellSampling(900 if moves else side**2)
    full = pushed(lambda theta: value(theta, own))
    return Found(
        full,
        pushed(lambda theta: value(theta, replace(own, boundary=False))),
        torch.stack(parts).mean(0),
        0.0,
    )


MIRROR = thing(plate(1.0, 1.0), (1.3, 0.9, 0.0), (0.0, 0.0, 1.4), METAL)
AIR = Dielectric(1.0)
RECEIVERS = float64([[0.7, 0.3, 0.35], [0.6, -0.2, -0.3]])


def strengths(out: RayPaths, home: RayPaths, turned: Tensor, *_: Tensor) -> Tensor:
    """What points bring that change the share χ of the power, of ways there and back."""
    power = [way.coefficient.abs().square().sum((1, 2)) for way in (out, home)]
    return (power[0] * power[1] * (1 - turned))[:, None]


def by_mirrors(scene: Scene, place: Tensor, sampling: Sampling, seed: int) -> Tensor:
    """Power that the wall scatters once, with a mirror before or after."""
    scene = Scene({"mirror": MIRROR, **scene.objects})
    rough = scene.replace("mirror", material=AIR)
    if rough["occluder"].cloud is None:
        rough = rough.replace("occluder", material=AIR)
    tx = place + float64([0.19, -0.07, 0.04])
    return trace_single_scattering(
        scene,
        rough,
        tx,
        RECEIVERS,
        1e9,
        strengths,
        1,
        rays=None,
        sampling=replace(sampling, depth=2),
        seed=seed,
    )


def mirrored_case(parameter: str) -> Found:
    wall = COATED if parameter in GEOMETRY else ROUGH
    scene, radar, move = occluder(wall=wall, occluder=METAL), power_radar(), MOVES[parameter]
    if parameter == "pose":  # turned, the occluder's shadow hardly changes
        scene = Scene({**scene.objects, "mirror": MIRROR})
        move = Move(Pose("mirror"), move.tangent)
    moves = parameter in GEOMETRY or parameter == "radar position"

    def value(theta: Tensor, samples: int, seed: int, boundary: bool = True) -> Tensor:
        changed = move(scene, radar, theta)
        own = Sampling(1, samples, 40_000, boundary=boundary)
        return by_mirrors(changed[0], changed[1].positions[0], own, seed)

    # Where no shadow moves, few points are as smooth as their derivative.
    step, samples, seeds = (0.02, 3_200_000, 2) if moves else (1e-4, 100_000, 1)
    parts = []
    for seed in range(seeds):
        ends = [value(torch.tensor(sign * step).double(), samples, seed) for sign in (1, -1)]
        parts.append((ends[0] - ends[1]) / (2 * step))
    own = 800_000 if moves else samples
    full = pushed(lambda theta: value(theta, own, 0))
    interior = pushed(lambda theta: value(theta, own, 0, False))
    return Found(full, interior, torch.stack(parts).mean(0), 0.0)


def chain_case(parameter: str) -> Found:
    """Chains between two plates, one of which hides the other; no random numbers."""
    scene, radar, moves = occluder(wall=METAL, occluder=METAL), field_radar(0.3), MOVES[parameter]

    def value(theta: Tensor) -> Tensor:
        moved, device = moves(scene, radar, theta)
        return at_carrier(trace_facet_paths(moved, device.link(), 2), device.link())

    up, down = (value(torch.tensor(sign * 1e-6).double()) for sign in (1, -1))
    found = pushed(value)
    return Found(found, found, (up - down) / 2e-6, 0.0)


def target_map(scene: Scene, radar: Radar) -> Tensor:
    """What a target sends back past the occluder, deposited: no random numbers."""
    link, grid = radar.link(), radar.grid(1.2, 2.8, oversample=4)

    def overlap(*gaps: Tensor) -> Tensor:
        return Surrogate().spread(radar, grid, *(0.5 * gap for gap in gaps))

    fields = trace_target(scene, "wall", link, sampling=Sampling(depth=1))
    return deposit_paths(combine_coherently(fields, link, overlap), link, grid).double()


def target_case(parameter: str) -> Found:
    """A target past which a straight edge of the occluder's shadow goes."""
    target = thing(plate(0.3, 0.15), (1.9, 0.19, 0.1), (0.0, 0.05, 0.1), METAL)
    scene = Scene({**occluder(occluder=ROUGH).objects, "wall": target})
    radar, moves = field_radar(0.3), MOVES[parameter]

    def value(theta: Tensor) -> Tensor:
        return target_map(*moves(scene, radar, theta))

    up, down = (value(torch.tensor(sign * 1e-3).double()) for sign in (1, -1))
    found = pushed(value)
    return Found(found, found, (up - down) / 2e-3, 0.0)


# A mirror of elements at the wall; a corner of the occluder's shadow lies on it.
PANEL = Metasurface(
    float64([1.85, 0.69, 0.37]),
    float64([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]),
    torch.zeros(20, 20, dtype=torch.float64),
    spacing=0.015,
)


def by_panel(scene: Scene, place: Tensor) -> Tensor:
    """What the panel sends from one antenna to another."""
    tx, rx = place + float64([[0.19, -0.07, 0.04]]), float64([[0.3, 0.9, 0.6]])
    return torch.view_as_real(panel_response(scene, PANEL, tx, rx, 1e10)).flatten()


# Right, down and ahead of a camera that looks along x.
LEVEL = float64([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def seen(scene: Scene, radar: Radar, sampling: ImageSampling, seed: int) -> Tensor:
    """Mask and depths of a camera where the radar stands.

    It is rolled: outlines along the rows of pixels move to other pixels all at once.
    """
    axes = rotation_from_vector(float64([0.5, 0.0, 0.0])) @ LEVEL
    axes = axes if radar.rotations is None else radar.rotations @ axes
    camera = Camera(radar.positions, axes, 6, 5, 9.0)
    mask = SilhouetteMap(("occluder",), sampling).predict(scene, camera, seed)
    return torch.cat([mask, DepthMap(4.0, sampling).predict(scene, camera, seed)])


def panel_case(parameter: str) -> Found:
    """Lit fractions of elements are exact, so differences are as smooth as the derivative."""

    def value(theta: Tensor) -> Tensor:
        scene, radar = changed(parameter, theta)
        return by_panel(scene, radar.positions)

    up, down = (value(torch.tensor(sign * 1e-5).double()) for sign in (1, -1))
    found = pushed(value)
    return Found(found, found, (up - down) / 2e-5, 0.0)


def image_case(parameter: str) -> Found:
    step, pairs, fine = 4e-3, 6, ImageSampling(samples=20_000)

    def value(theta: Tensor, sampling: ImageSampling, seed: int = 0) -> Tensor:
        return seen(*changed(parameter, theta), sampling, seed)

    ends = [
        [value(torch.tensor(sign * step).double(), fine, seed) for sign in (1, -1)]
        for seed in range(pairs)
    ]
    differences = torch.stack([(up - down) / (2 * step) for up, down in ends])
    truth = differences.mean(0)
    noise = differences.std(0).div(math.sqrt(pairs)).sum() / truth.abs().sum().clamp_min(1e-300)
    own = ImageSampling(samples=256, outline_samples=1000)
    full = pushed(lambda theta: value(theta, own))
    return Found(
        full,
        pushed(lambda theta: value(theta, replace(own, boundary=False))),
        truth,
        float(noise),
    )


def changed(parameter: str, theta: Tensor) -> tuple[Scene, Radar]:
    """Scene and radar at θ."""
    walls = dict.fromkeys(GEOMETRY, METAL) | dict.fromkeys(
        ("diffuse fraction", "lobe width"), ROUGH
    )
    scene = occluder(wall=walls.get(parameter, COATED), occluder=METAL)
    if parameter == "object velocity":
        return scene.replace("wall", velocity=theta * float64([1.0, 0.3, 0.2])), power_radar()
    return MOVES[parameter](scene, power_radar(), theta)


_power: dict[str, Found] = {}


def case(parameter: str, mechanism: str) -> Found:
    if mechanism == "coherent":
        return coherent_case(parameter)
    if mechanism == "rough":
        return rough_case(parameter)
    if mechanism == "signature":
        return signature_case(parameter)
    if mechanism == "antennas":
        return antenna_case(parameter)
    if mechanism == "chains":
        return chain_case(parameter)
    if mechanism == "targets":
        return target_case(parameter)
    if mechanism == "coverage":
        return coverage_case(parameter)
    if mechanism == "mirrored":
        return mirrored_case(parameter)
    if mechanism == "panels":
        return panel_case(parameter)
    if mechanism == "images":
        return image_case(parameter)
    if parameter not in _power:
        _power[parameter] = bias_case() if parameter == "range bias" else power_case(parameter)
    return _power[parameter]


def test_the_table_is_whole():
    named = {parameter for parameter, _ in CELLS}
    assert named == {*MOVES, "range bias", "clock offset", "reverberant tail", *REFUSALS}
    assert len(CELLS) == len(MECHANISMS) * len(named)
    assert set(CELLS.values()) == {"supported", "zero", "refused", "–"}


def selected(word: str, *, bounces: bool = False) -> list[Any]:
    return [
        pytest.param(*cell, id=re.sub(r"\W+", "_", " ".join(cell)), marks=marks_of(cell))
        for cell, said in CELLS.items()
        if said == word and cell[1].startswith("bounces") == bounces
    ]


def marks_of(cell: tuple[str, str]) -> list[pytest.MarkDecorator]:
    """The marks of a cell's test; one of two bounces stands for all in `make test`."""
    parameter, mechanism = cell
    if cell == ("translation", "bounces boundary"):
        return [pytest.mark.slow, pytest.mark.claim]
    long = {"pose", "scale", "vertices", "radar position"}
    many = mechanism in ("coherent", "mirrored") and parameter in long
    return [pytest.mark.slow] if many or mechanism.startswith("bounces") else []


@pytest.mark.parametrize(("parameter", "mechanism"), selected("supported"))
def test_supported(parameter, mechanism):
    found = case(parameter, mechanism)
    assert found.noise < 0.02
    assert float(found.truth.abs().sum()) > 0
    assert relative(found.full, found.truth) < 0.03
    if mechanism == "boundary":
        assert relative(found.interior, found.truth) > 3 * relative(found.full, found.truth)


@pytest.mark.parametrize(("parameter", "mechanism"), selected("zero"))
def test_zero(parameter, mechanism):
    found = case(parameter, mechanism)
    if mechanism == "boundary":
        # Atomic additions reorder; there is no boundary term in either.
        assert relative(found.full, found.interior) < 1e-5
    else:
        assert not found.full.any()
        assert not found.truth.any()


def attempt(mechanism: str, scene: Scene, radar: Radar) -> None:
    """Use a scene and a radar as the mechanism does."""
    if mechanism == "signature":
        section(scene)
        return
    if mechanism == "antennas":
        between(scene, radar.positions[0])
        return
    if mechanism == "coverage":
        covered(scene, radar.positions[0], CellSampling(1))
        return
    if mechanism == "mirrored":
        by_mirrors(scene, radar.positions[0], Sampling(1, 1_000, 100), 0)
        return
    if mechanism == "panels":
        by_panel(scene, radar.positions)
        return
    if mechanism == "images":
        seen(scene, radar, ImageSampling(1), 0)
        return
    if mechanism == "targets":
        target_map(scene, radar)
        return
    if mechanism == "chains":
        exact_spectrum(
            beat_signal(trace_facet_paths(scene, radar.link(), 2), radar),
            radar,
            radar.grid(0.4, 2.8),
        )
        return
    if mechanism.endswith(("interior", "boundary")):
        grid = radar.grid(0.4, 2.8, 0.6)
        drawn = Sampling(
            depth=2 if mechanism.startswith("bounces") else 1,
            samples=1_000,
            boundary_samples=100,
            boundary=mechanism.endswith("boundary"),
        )
        surrogate_spectrum(scene, radar, grid, Surrogate(), sampling=drawn, seed=0)
        return
    paths = trace_field(
        scene,
        radar.link(),
        sampling=Sampling(
            depth=1, conductor_samples=1_000, boundary_samples=100, points_per_m2=100.0
        ),
        seed=0,
    )
    exact_spectrum(beat_signal(paths, radar), radar, radar.grid(0.4, 2.8, 0.6))


def velocity(scene: Scene, radar: Radar) -> tuple[Scene, Radar]:
    return scene.replace(
        "wall", velocity=torch.zeros(3, dtype=torch.float64).requires_grad_()
    ), radar


def patterns(scene: Scene, radar: Radar) -> tuple[Scene, Radar]:
    gains = torch.ones(2, 1, dtype=torch.float64, requires_grad=True)
    pattern = TabulatedPattern(float64([0.0, 1.5]), float64([0.0]), gains)
    return scene, replace(radar, receivers=replace(radar.receivers, pattern=pattern))


def polarisations(scene: Scene, radar: Radar) -> tuple[Scene, Radar]:
    vector = torch.ones(2, dtype=torch.complex128, requires_grad=True)
    return scene, replace(radar, receivers=replace(radar.receivers, polarisation=vector))


def elements(scene: Scene, radar: Radar) -> tuple[Scene, Radar]:
    places = radar.receivers.positions.clone().requires_grad_()
    return scene, replace(radar, receivers=AntennaArray(places))


REFUSALS: dict[str, Callable[[Scene, Radar], tuple[Scene, Radar]]] = {
    "object velocity": velocity,
    "antenna pattern": patterns,
    "antenna polarisation": polarisations,
    "element positions": elements,
}
NAMES = {
    "object velocity": "velocities on wall",
    "antenna pattern": "expected a pattern without derivatives",
    "antenna polarisation": "expected a polarisation without derivatives",
    "element positions": "expected element positions without derivatives",
    "permittivity": "expected a material with permittivity",
    "conductivity": "expected a material with conductivity",
    "diffuse fraction": "expected a material with diffuse",
    "depolarisation": "expected a material with depolarisation",
    "density": "expected objects with surfaces, got clouds for occluder",
}
REFUSED = [cell for cell, said in CELLS.items() if said == "refused"]


@pytest.mark.parametrize(("parameter", "mechanism"), REFUSED)
def test_refused(parameter, mechanism):
    surface = METAL if mechanism in ("coherent", "chains", "targets") else ROUGH
    scene, radar = occluder(wall=surface, occluder=surface), power_radar()
    message = NAMES.get(parameter, "expected no geometry derivative of rough field paths")
    theta = torch.zeros((), dtype=torch.float64, requires_grad=True)

    def change() -> tuple[Scene, Radar]:
        if parameter in REFUSALS:
            return REFUSALS[parameter](scene, radar)
        return MOVES[parameter](scene, radar, theta)

    with pytest.raises(InputError, match=message):
        attempt(mechanism, *change())
    if parameter in MOVES and mechanism == "rough":
        few = Sampling(depth=1, boundary_samples=0, points_per_m2=100.0)
        with pytest.raises(InputError, match=message):
            pushed(lambda t: response(*MOVES[parameter](scene, radar, t), few, 0))


def test_a_pattern_of_ones_own_is_refused_too():
    class Own(Cosine):
        def table(self) -> Tensor:
            return super().table() * torch.ones(1, dtype=torch.float64, requires_grad=True)

    radar = power_radar()
    radar = replace(radar, receivers=replace(radar.receivers, pattern=Own(2.0)))
    with pytest.raises(InputError, match="expected an antenna pattern without derivatives"):
        deposit_power(
            occluder(),
            radar.link(),
            radar.grid(0.4, 2.8),
            sampling=Sampling(depth=1, samples=100, boundary_samples=0),
            seed=0,
        )


def test_a_lobe_that_starts_at_nothing_has_its_derivative():
    """At diffuse = 1 the lobe weighs nothing, yet its derivative does."""
    scene, radar = occluder(), power_radar()
    grid = radar.grid(0.4, 2.8, 0.6, oversample=1)

    def value(share: Tensor) -> Tensor:
        surface = RoughDielectric(4.0, 0.0, 1 - share)
        moved = scene.replace("wall", material=surface)
        return deposit_power(
            moved,
            radar.link(),
            grid,
            sampling=Sampling(depth=1, samples=50_000, boundary_samples=0),
            seed=0,
        ).double()

    rate = pushed(value)
    whole = value(torch.tensor(0.5).double()) - value(torch.zeros(()).double())
    assert relative(rate, whole / 0.5) < 1e-4
