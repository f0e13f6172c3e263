"""Old spellings of version 0.3: each warns in one line that names the new one, and works."""

import ast
import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import invertwin as iw
from invertwin import models
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel
from invertwin.inversion.loss import resolve_loss

ROOMS = (
    iw, iw.capture, iw.channel, iw.datasets, iw.discovery, iw.inversion, iw.links, iw.plotting,
    iw.radar, iw.scene, iw.viewer, models,
)  # fmt: skip


def radar() -> iw.Radar:
    chirp = iw.FMCW(start_frequency=77e9, bandwidth=2e9, duration=50e-6, samples=64)
    row = iw.linear_array(4, chirp.wavelength / 2)
    return iw.Radar(iw.linear_array(1, 1.0), row, chirp, positions=torch.zeros(1, 3).double())


def ball() -> iw.Scene:
    place = iw.rigid(translation=[0.0, 0.0, 2.0])
    return iw.Scene({"ball": iw.Object(iw.box((0.1, 0.1, 0.1)), iw.PerfectConductor(), place)})


def renamed() -> Iterator[tuple[Any, str, str]]:
    """Every old name of every menu, read from the calls of ``rename_attributes``."""
    for room in ROOMS:
        assert room.__file__ is not None
        for node in ast.walk(ast.parse(Path(room.__file__).read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "rename_attributes":
                for old, new in ast.literal_eval(node.args[1]).items():
                    yield room, old, new


@pytest.mark.parametrize(("room", "old", "new"), [pytest.param(*x, id=x[1]) for x in renamed()])
def test_an_old_name_of_a_menu_warns_and_is_the_new_one(room, old, new):
    path = new if "." in new else f"{room.__name__}.{new}".removeprefix("invertwin.")
    with pytest.warns(DeprecationWarning, match=f"^deprecated: .*{old} → invertwin.{path}$"):
        found = getattr(room, old)
    target = iw
    for part in path.split("."):
        target = getattr(target, part)
    assert found is target
    assert old not in dir(room)


@pytest.mark.parametrize("room", ROOMS, ids=lambda room: room.__name__)
def test_a_name_that_never_was_is_an_error(room):
    with pytest.raises(AttributeError, match="never_was"):
        room.never_was  # noqa: B018


def test_an_observation_with_the_radar_in_second_place_warns():
    device = radar()
    model, capture = models.ExactMap(device.grid(1.0, 3.0)), torch.ones(1, 3, 2, 1)
    with pytest.warns(DeprecationWarning, match=r"Observation\(model, sensor, data\) → Observ"):
        old = iw.Observation(model, device, capture, 2.0)
    new = iw.Observation(model, capture, sensor=device, weight=2.0)
    assert (old.model, old.sensor, old.weight) == (new.model, new.sensor, new.weight)
    assert old.data is new.data is capture


def test_an_observation_takes_the_radar_of_its_capture():
    device = radar()
    grid = device.grid(1.0, 3.0)
    few = iw.Sampling(depth=1, boundary=False, conductor_samples=10)
    data = iw.simulate(ball(), device, grid, seed=1, sampling=few)
    seen = iw.Observation(models.ExactMap(grid), data.capture)
    assert torch.equal(seen.sensor.positions, device.positions)
    assert torch.equal(seen.observed_map(), data.spectrum.float())
    with pytest.raises(InputError, match=r"got Tensor; give Observation\(model, data, sensor="):
        iw.Observation(models.ExactMap(grid), data.spectrum)


def test_samples_for_fields_of_conductors_warn():
    device = radar()
    grid = device.grid(1.0, 3.0)

    def signal(**counts: Any) -> Tensor:
        drawn = iw.Sampling(depth=1, boundary=False, **counts)
        return iw.simulate(ball(), device, grid, seed=1, sampling=drawn).beat

    with pytest.warns(DeprecationWarning, match=r"samples=.* → Sampling\(conductor_samples=...\)"):
        old = signal(samples=20)
    new = signal(samples=10, conductor_samples=20)
    assert torch.equal(old, new)
    assert not torch.equal(new, signal(conductor_samples=21))


def test_a_partial_function_for_an_rcs_map_warns(unchecked):
    options: dict[str, Any] = {"directions": [[0.0, 0.0, 1.0]], "frequencies": [10e9]}
    part: Any = partial(iw.rcs, **options)
    with pytest.warns(DeprecationWarning, match=r"RcsMap\(partial.* → RcsMap\(directions"):
        old = models.RcsMap(part)
    plate = iw.Scene({"plate": iw.Object(iw.plate(0.3, 0.3), iw.PerfectConductor())})
    new = models.RcsMap(**options)
    assert torch.equal(old.predict(plate, None, 0), new.predict(plate, None, 0))
    assert iw.Observation(new, iw.rcs(plate, **options)).sensor is None
    with pytest.raises(InputError, match="expected directions and frequencies for an RcsMap"):
        models.RcsMap()


def test_a_model_with_methods_of_old_names_is_not_ignored():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")

        class Mine(ForwardModel):
            smooth = False

            def predict(self, scene: iw.Scene, sensor: Any, seed: int) -> Tensor:
                return torch.ones(1, 2)

            def observe(self, recording: Any) -> Tensor:
                return recording

            def looks(self, scene: iw.Scene, sensor: Any, seed: int) -> Any:
                return lambda number, noise: torch.zeros(1, 2)

            def narrowed(self, share: float) -> ForwardModel:
                return self

            @property
            def widened(self) -> bool:
                return True

    told = [str(warning.message).split(": ")[1] for warning in caught]
    name = Mine.__qualname__
    assert sorted(told) == [
        f"{name}.looks → {name}.realisations",
        f"{name}.narrowed → {name}.scale_blur",
        f"{name}.smooth → {name}.is_smooth",
        f"{name}.widened → {name}.has_blur",
    ]
    mine = Mine()
    assert mine.has_blur
    assert not mine.is_smooth
    drawn = mine.realisations(ball(), None, 0)
    assert drawn is not None
    assert float(drawn(0, 0.0).sum()) == 0.0


def test_the_default_loss_is_the_likelihood_of_power():
    grid = radar().grid(1.0, 3.0)
    smooth = models.SurrogateMap(grid)
    assert resolve_loss(smooth, None) == iw.SpectrumLoss("likelihood")
    levels = iw.SpectrumLoss("mse", levels=1, gain="one")
    assert resolve_loss(models.FacetField(grid), None) == levels
    with pytest.raises(InputError, match=r"expected power .* fields or levels of a FacetField"):
        resolve_loss(models.FacetField(grid), iw.SpectrumLoss())
    with pytest.raises(InputError, match=r"expected power .* complex or negative"):
        resolve_loss(smooth, None, torch.tensor([[1.0, -1.0]]))


@pytest.mark.parametrize(
    ("given", "angle_width"),
    [({}, 1.5), ({"degrees": 7.0}, None), ({"distance": 2.0}, None)],
    ids=str,
)
def test_a_blur_is_as_wide_as_the_error_of_the_start(given, angle_width):
    device = radar()
    blur = iw.Surrogate.for_start_error(0.3, device, **given)
    assert blur.range_width * device.waveform.range_resolution == pytest.approx(0.3)
    if angle_width is None:
        sine = {"degrees": 0.12187, "distance": 0.3 / (0.3**2 + 2.0**2) ** 0.5}[next(iter(given))]
        assert blur.angle_width * device.beamwidth[0] == pytest.approx(sine, rel=1e-3)
    else:
        assert blur.angle_width == angle_width


def test_a_start_error_is_an_angle_or_seen_from_a_distance(unchecked):
    with pytest.raises(InputError, match="expected a distance or an error in degrees, got both"):
        iw.Surrogate.for_start_error(0.3, radar(), distance=2.0, degrees=5.0)
    with pytest.raises(InputError, match="error of the start"):
        iw.Surrogate.for_start_error(-0.3, radar())
