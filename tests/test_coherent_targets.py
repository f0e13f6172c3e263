"""Maps of scenes with coherent targets: peaks, lobes and totals of fields, sums with the rough."""

import math
from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from invertwin.channel import Sampling, as_absorbers, trace_facet_paths, trace_field
from invertwin.errors import InputError
from invertwin.inversion.gradcheck.gradcheck import GradcheckSettings, gradcheck
from invertwin.models.facets import FacetMap
from invertwin.models.radar import SurrogateMap
from invertwin.radar import FMCW, Radar, Surrogate, beat_signal, exact_spectrum
from invertwin.scene import (
    AntennaArray,
    Mesh,
    Object,
    PerfectConductor,
    Scene,
    dihedral,
    linear_array,
    plate,
    rigid,
    rotation_from_vector,
    trihedral,
)
from invertwin.scene.parameters import Pose
from scenes import float64, radar, relative, thing

METAL = PerfectConductor()
DEVICE = radar()
GRID = DEVICE.grid(2.4, 3.6, 0.3)
AT = (3.0, 0.1, 0.0)
TOWARDS = math.atan2(AT[1], AT[0])  # a turn about z that makes a target there face the radar
MESHES = {"trihedral": (trihedral(0.05), 3), "dihedral": (dihedral(0.05), 2)}
MESHES["plate"] = plate(0.05, 0.05), 1


def alone(mesh: Mesh, turn: Sequence[float] = (0.0, 0.0, 0.0), at: Sequence[float] = AT) -> Scene:
    return Scene({"target": thing(mesh, at, turn, METAL)})


def walled(scene: Scene) -> Scene:
    """The scene with a rough board behind it."""
    return Scene({**scene.objects, "board": thing(plate(1.5, 1.5), (3.4, 0.0, 0.0))})


def decibel(found: Tensor, truth: Tensor) -> Tensor:
    return 10 * torch.log10(found / truth)


@pytest.mark.parametrize("name", list(MESHES))
def test_peak_and_lobe_are_those_of_the_field(name):
    """Before a board, turned by up to ±10°: cells within 10 dB of the peak within 0.2 dB.

    The truth is |Σ fields|² of beat signals, plus the board alone, behind the target's shadow.
    """
    mesh, depth = MESHES[name]
    drawn = Sampling(depth=depth, samples=20_000, boundary_samples=0)
    model = SurrogateMap(GRID, sampling=drawn, coherent=["target"])
    tops, worst = [], 0.0
    for degrees in (-10, -5, -2, -1, 0, 1, 2, 5, 10):
        scene = alone(mesh, (0.0, 0.0, math.radians(degrees) + TOWARDS))
        field = FacetMap(GRID, sampling=drawn).predict(scene, DEVICE, 0)
        rough = replace(model, coherent=()).predict(
            as_absorbers(walled(scene), ["target"]), DEVICE, 1
        )
        found = model.predict(walled(scene), DEVICE, 1)
        truth = field + rough
        tops.append(float(field.max()))
        cells = field > 0.1 * max(tops[-1], float(rough.max()))
        if cells.any():
            worst = max(worst, float(decibel(found[cells], truth[cells]).abs().max()))
    assert worst < 0.2
    assert tops.index(max(tops)) == 4
    falls = 10 * math.log10(min(tops) / max(tops))
    assert falls < -20 if name == "plate" else -5 < falls < -0.5


@pytest.mark.parametrize(("name", "low"), [("trihedral", 7.0), ("dihedral", 3.0), ("plate", None)])
def test_straight_on_a_target_is_as_strong_as_sampled_rays_say(name, low):
    """Within 0.3 dB, peak and total. Lobes, whose bounces add in power, fail."""
    mesh, depth = MESHES[name]
    scene = alone(mesh, (0.0, 0.0, TOWARDS))
    drawn = Sampling(depth=depth, samples=60_000, conductor_samples=60_000, boundary=False)
    paths = trace_field(scene, DEVICE.link(), sampling=drawn, seed=1)
    truth = exact_spectrum(beat_signal(paths, DEVICE), DEVICE, GRID)
    model = SurrogateMap(GRID, sampling=drawn, coherent=["target"])
    found = model.predict(scene, DEVICE, 0)
    for ends in ((found.max(), truth.max()), (found.sum(), truth.sum())):
        assert abs(float(decibel(*ends))) < 0.3
    if low is not None:
        lobes = replace(model, coherent=()).predict(scene, DEVICE, 0)
        assert float(decibel(truth.max(), lobes.max())) > low


def test_two_targets_in_one_cell_are_the_mean_over_wavelengths():
    """|Σ fields|² fringes twice a wavelength; its mean over shifts is the map, which does not."""
    model = SurrogateMap(GRID, sampling=Sampling(3), coherent=["target", "other"])
    wave, fields, maps = DEVICE.waveform.wavelength, [], []
    for shift in torch.linspace(0, 0.5 * wave, 9)[:-1]:
        scene = alone(trihedral(0.05), at=(3.0, 0.06, 0.0))
        other = thing(trihedral(0.04), (3.0 + float(shift), 0.0, 0.0), material=METAL)
        scene = Scene({**scene.objects, "other": other})
        # Each by itself: beams of both together would see one another.
        beats = [
            beat_signal(trace_facet_paths(Scene({n: o}), DEVICE.link(), 3), DEVICE)
            for n, o in scene.objects.items()
        ]
        fields.append(exact_spectrum(beats[0] + beats[1], DEVICE, GRID))
        maps.append(model.predict(scene, DEVICE, 0).double())
    tops = torch.stack(fields).amax((1, 2, 3, 4))
    assert float(tops.max() / tops.min()) > 5
    calm = torch.stack(maps).amax((1, 2, 3, 4))
    assert float(calm.max() / calm.min()) < 1.02
    mean = torch.stack(fields).mean(0)
    cells = mean > 0.1 * mean.max()
    assert float(decibel(maps[0][cells], mean[cells]).abs().max()) < 0.3


def test_on_a_rough_wall_a_target_is_the_mean_over_speckle():
    """A corner that leans on a wall, in one cell with it: sums of powers, shadow included."""
    scene = Scene(
        {
            "target": thing(trihedral(0.025), (3.0, 0.0, 0.0), material=METAL),
            "wall": thing(plate(1.5, 1.5), (3.02, 0.0, 0.0)),
        }
    )
    drawn = Sampling(depth=1, samples=200_000, boundary_samples=0, points_per_m2=4000.0)
    deep = replace(drawn, depth=3)
    found = SurrogateMap(GRID, sampling=deep, coherent=["target"]).predict(scene, DEVICE, 1)
    target = trace_facet_paths(Scene({"target": scene["target"]}), DEVICE.link(), 3)
    dark = as_absorbers(scene, ["target"])
    looks = []
    for seed in range(64):
        rough = trace_field(dark, DEVICE.link(), sampling=replace(drawn, boundary=False), seed=seed)
        beat = beat_signal(rough + target, DEVICE)
        looks.append(exact_spectrum(beat, DEVICE, GRID))
    mean = torch.stack(looks).mean(0)
    middle = int(found.argmax())
    assert float(found.flatten()[middle] / mean.flatten()[middle]) == pytest.approx(1, abs=0.1)
    assert float(found.sum() / mean.sum()) == pytest.approx(1, abs=0.05)
    # Neither part is negligible there.
    wall = replace(SurrogateMap(GRID, sampling=drawn)).predict(dark, DEVICE, 1)
    assert 0.2 < float(wall.flatten()[middle] / found.flatten()[middle]) < 0.8


def test_the_loss_of_a_place_falls_steadily_where_fields_fringe():
    """Along the range towards a truth beside a rough wall, over 10 wavelengths."""
    drawn = Sampling(depth=3, samples=20_000, boundary_samples=0)
    wide = Surrogate(range_width=2.0)
    smooth = SurrogateMap(GRID, wide, drawn, coherent=["target", "still"])
    fringed = FacetMap(GRID, wide, drawn)
    # Higher by 1 mm: both would count where they overlap in one plane, which is refused.
    still = thing(trihedral(0.05), (3.0, 0.06, 0.001), material=METAL)

    def at(x: float) -> Scene:
        return Scene({**alone(trihedral(0.05), at=(3.0 + x, 0.0, 0.0)).objects, "still": still})

    for model, steady in ((smooth, True), (fringed, False)):
        truth = model.predict(at(0.0), DEVICE, 0)
        losses = [
            float((model.predict(at(float(x)), DEVICE, 0) - truth).square().mean())
            for x in torch.linspace(0.0003, 0.04, 30)
        ]
        assert bool((torch.tensor(losses).diff() > 0).all()) == steady


def test_a_stretched_wavelength_widens_the_basin_of_a_turn():
    """Of a plate, 8° to 1.6° off: sidelobes are minima of the loss, but not at four wavelengths."""
    model = SurrogateMap(GRID, sampling=Sampling(1), coherent=["target"])
    turns = torch.linspace(math.radians(1.6), math.radians(8), 33)
    truth = model.predict(alone(plate(0.05, 0.05), (0.0, 0.0, TOWARDS)), DEVICE, 0)
    minima = {}
    for stretch in (1.0, 4.0):
        own = replace(model, stretch=stretch)
        losses = []
        for turn in turns.tolist():
            found = own.predict(alone(plate(0.05, 0.05), (0.0, 0.0, TOWARDS + turn)), DEVICE, 0)
            losses.append(float((found - truth).square().mean()))
        slopes = torch.tensor(losses).diff()
        minima[stretch] = int(((slopes[:-1] < 0) & (slopes[1:] > 0)).sum())
    assert minima[1.0] >= 2
    assert minima[4.0] == 0


def test_the_map_has_derivatives_with_the_edges_of_beams():
    """By place and turn; with beams' edges fixed the derivative by turns is wrong."""
    model = SurrogateMap(GRID, sampling=Sampling(3, boundary_samples=0), coherent=["target"])
    tangents = {"place": (0.5, 0.3, 0.2, 0.0, 0.0, 0.0), "turn": (0.0, 0.0, 0.0, 0.2, 0.6, 0.7)}

    def predicted(theta: Tensor, tangent: Tensor, model: SurrogateMap) -> Tensor:
        at = theta * tangent
        base = float64([0.0, 0.1, 0.12])
        pose = rigid(rotation_from_vector(base + at[3:]), float64(AT) + at[:3])
        scene = Scene({"target": Object(trihedral(0.05), METAL, pose)})
        return model.predict(scene, DEVICE, 0).double()

    for name, numbers in tangents.items():
        tangent, zero = float64(numbers), torch.zeros((), dtype=torch.float64)
        step = 1e-3
        up, down = (predicted(zero + s * step, tangent, model) for s in (1, -1))
        truth = (up - down) / (2 * step)
        found = []
        for own in (model, replace(model, sampling=replace(model.sampling, boundary=False))):
            with forward_ad.dual_level():
                theta = forward_ad.make_dual(zero, torch.ones_like(zero))
                found.append(forward_ad.unpack_dual(predicted(theta, tangent, own)).tangent)
        error = relative(found[0], truth)
        assert error < 0.01
        if name == "turn":
            assert relative(found[1], truth) > max(3 * error, 0.1)


def test_gradient_checks_hold_before_a_rough_wall():
    """The echo of a target and its shadow on the wall, by a turn; fixed edges fail."""
    grid = DEVICE.grid(2.4, 3.6, 0.3, oversample=1)
    wide = Surrogate("gaussian", range_width=2.0, angle_width=1.0)
    drawn = Sampling(3, samples=20_000, boundary_samples=8_000)
    report = gradcheck(
        SurrogateMap(grid, wide, drawn, coherent=["target"]),
        Pose("target"),
        {"rotation": float64([0.2, 0.6, 0.7])},
        scene=walled(alone(trihedral(0.05), (0.0, 0.1, 0.12))),
        sensor=DEVICE,
        settings=GradcheckSettings(repeats=1, difference_samples=30_000, noise=0.01, max_pairs=4),
    )
    error = relative(report.gradient, report.difference)
    assert error < 0.02
    assert relative(report.interior_gradient, report.difference) > max(3 * error, 0.1)


def test_batches_and_references_have_the_targets_of_single_maps():
    drawn = Sampling(depth=1, samples=100_000, boundary_samples=0)
    model = SurrogateMap(GRID, sampling=drawn, coherent=["target"], stretch=2.0)
    scenes = [walled(alone(plate(0.05, 0.05), at=(3.0, y, 0.0))) for y in (0.0, 0.1)]
    both = model.predict_batch(scenes, DEVICE, 0)
    for found, scene in zip(both, scenes, strict=True):
        single = model.predict(scene, DEVICE, 0)
        assert relative(found, single) < 0.05
        fixed = model.for_differences(scene, DEVICE, 100_000, "rays")
        assert relative(fixed.predict(scene, DEVICE, 0), single) < 0.05


def test_a_fit_narrows_the_stretch_with_the_widths():
    model = SurrogateMap(GRID, Surrogate(range_width=2.0), coherent=("target",), stretch=3.0)
    half = model.scale_blur(0.5)
    assert (half.kernels.range_width, half.stretch) == (1.0, 2.0)
    end = model.scale_blur(0.0)
    assert end.stretch == 1.0
    assert not end.has_blur
    assert SurrogateMap(GRID, coherent=["target"], stretch=1.5).has_blur


def test_looks_have_other_phases_of_targets():
    """Their mean is the map; a target alone is the same in all of them."""
    few = Sampling(depth=3, samples=50_000, boundary_samples=0, points_per_m2=2000.0)
    model = SurrogateMap(GRID, sampling=few, coherent=["target"])
    scene = walled(alone(trihedral(0.02), at=(3.3, 0.1, 0.0)))
    look = model.realisations(scene, DEVICE, 0)
    assert look is not None
    found = torch.stack([look(number, 0.0) for number in range(48)])
    expected = model.predict(scene, DEVICE, 0).flatten()
    cell = int(expected.argmax())
    values, mean = found.flatten(1)[:, cell], expected[cell]
    assert float(values.mean() / mean) == pytest.approx(1, abs=0.2)
    assert float(values.std() / values.mean()) > 0.1
    assert replace(model, coherent=()).realisations(scene, DEVICE, 0) is None


def test_targets_are_given_by_names_and_the_stretch_needs_some():
    with pytest.raises(
        InputError, match="expected a list of names of objects, got 'target'; give coher"
    ):
        SurrogateMap(GRID, coherent="target")
    for stretch, names in ((2.0, []), (0.5, ["target"])):
        with pytest.raises(InputError, match="expected a stretch >= 1 of coherent targets"):
            SurrogateMap(GRID, coherent=names, stretch=stretch)
    model, fine = SurrogateMap(GRID, coherent=["target"]), alone(plate(0.05, 0.05, divisions=4))
    with pytest.raises(InputError, match="expected at most 24 triangles"):
        model.predict(fine, DEVICE, 0)


def test_echoes_of_one_target_in_different_cells_add_in_power():
    """Two plates of one object, 0.6 m apart: |Σ fields|² of both cells, none between."""
    near, far = plate(0.04, 0.04), plate(0.04, 0.04)
    points = torch.cat([near.vertices, far.vertices + float64([0.6, 0.05, 0.0])])
    both = Mesh(points, torch.cat([near.faces, far.faces + len(near.vertices)]))
    pair = Scene({"target": thing(both, (2.7, 0.0, 0.0), material=METAL)})
    drawn = Sampling(depth=1)
    found = SurrogateMap(GRID, sampling=drawn, coherent=["target"]).predict(pair, DEVICE, 0)
    truth = FacetMap(GRID, sampling=drawn).predict(pair, DEVICE, 0)
    assert relative(found, truth) < 0.05


def test_arrays_that_are_no_product_and_other_kernels_serve_too():
    """An L of elements, an Airy lobe, one channel without directions."""
    one = AntennaArray(torch.zeros(1, 3, dtype=torch.float64))
    steps = 1.95e-3 * torch.arange(8, dtype=torch.float64)
    zero = torch.zeros_like(steps)
    places = torch.cat([torch.stack([zero, steps, zero], 1), torch.stack([zero, zero, steps], 1)])
    waveform = FMCW(76e9, 2e9, 50e-6, 64)
    scene = alone(trihedral(0.05))
    for arrays, kernels in (
        ((one, AntennaArray(places[1:])), "response"),
        ((one, linear_array(16, 1.95e-3)), "gaussian"),
        ((one, one), "dirichlet"),
    ):
        device = Radar(*arrays, waveform, float64([[0.0, 0.0, 0.0]]), array_window="rectangular")
        grid = device.grid(2.4, 3.6, 0.3)
        model = SurrogateMap(grid, kernels, Sampling(3), coherent=["target"])
        truth = FacetMap(grid, sampling=Sampling(3)).predict(scene, device, 0)
        found = model.predict(scene, device, 0)
        assert float(found.max() / truth.max()) == pytest.approx(1, abs=0.05)
