"""Old spellings of version 0.3: each warns in one line that names the new one, and works."""

import importlib
import inspect
import operator
import os
import pickle
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

import invertwin as iw
from invertwin import models
from invertwin.deprecation import (
    RenamedMember,
    read_renamed_attributes,
    rename_arguments,
    rename_members,
)
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel
from invertwin.inversion.loss import resolve_loss

ROOMS = (
    iw, iw.capture, iw.channel, iw.datasets, iw.discovery, iw.inversion, iw.links, iw.plotting,
    iw.radar, iw.scene, iw.viewer, models, importlib.import_module("invertwin.signatures"),
)  # fmt: skip


def radar() -> iw.Radar:
    chirp = iw.FMCW(start_frequency=77e9, bandwidth=2e9, duration=50e-6, samples=64)
    row = iw.linear_array(4, chirp.wavelength / 2)
    return iw.Radar(iw.linear_array(1, 1.0), row, chirp, positions=torch.zeros(1, 3).double())


def ball() -> iw.Scene:
    place = iw.rigid(translation=[0.0, 0.0, 2.0])
    return iw.Scene({"ball": iw.Object(iw.box((0.1, 0.1, 0.1)), iw.PerfectConductor(), place)})


def renamed() -> Iterator[tuple[Any, str, str]]:
    """Every old name of every menu."""
    for module, names in read_renamed_attributes().items():
        parts = module.split(".")
        if len(parts) > 2 and not inspect.ismodule(
            getattr(importlib.import_module(".".join(parts[:2])), parts[2], None)
        ):
            continue  # members of a class, or arguments
        room = importlib.import_module(module)
        for old, new in names.items():
            yield room, old, new


def bridged() -> list[Any]:
    """Every class and function, and every method, in files that bridge members or arguments."""
    root = Path(str(iw.__path__[0]))
    found: dict[Any, None] = {}
    for path in sorted(root.rglob("*.py")):
        if "import rename_" in path.read_text(encoding="utf-8"):
            parts = path.relative_to(root.parent).with_suffix("").parts
            module = importlib.import_module(".".join(parts).removesuffix(".__init__"))
            for value in list(vars(module).values()):
                if inspect.isclass(value) and value.__module__.startswith("invertwin."):
                    methods = [getattr(x, "__func__", x) for x in list(vars(value).values())]
                    found |= dict.fromkeys([value, *filter(inspect.isfunction, methods)])
                elif inspect.isfunction(value):
                    found[value] = None
    return list(found)


def renamed_members() -> list[Any]:
    """Every old name of a member of a class."""
    return [
        pytest.param(cls, old, id=f"{cls.__name__}.{old}")
        for cls in bridged()
        if inspect.isclass(cls)
        for old, member in vars(cls).items()
        if isinstance(member, RenamedMember)
    ]


def renamed_arguments() -> list[Any]:
    """Every old name of an argument, of a function, a method or a constructor."""
    return [
        pytest.param(function, old, new, id=f"{function.__qualname__}({old})")
        for function in bridged()
        if inspect.isfunction(function)
        for old, new in getattr(function, "renamed_arguments", {}).items()
    ]


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


@pytest.mark.parametrize(("cls", "old"), renamed_members())
def test_an_old_name_of_a_member_warns_and_is_the_new_one(cls, old):
    member = vars(cls)[old]
    if "." in member.new:
        assert callable(operator.attrgetter(member.new)(iw))
        return
    known = {name for base in cls.__mro__ for name in inspect.get_annotations(base)}
    if not hasattr(cls, member.new) and member.new not in known:
        assert f"self.{member.new}" in inspect.getsource(cls)
    for base in cls.__mro__:
        assert old not in inspect.get_annotations(base)
    with pytest.warns(DeprecationWarning, match=rf"^deprecated: \w+\.{old} → \w+\.{member.new}$"):
        assert member.__get__(SimpleNamespace(**{member.new: "found"}), cls) == "found"


@pytest.mark.parametrize(("function", "old", "new"), renamed_arguments())
def test_an_old_name_of_an_argument_warns_and_is_the_new_one(function, old, new):
    known = inspect.signature(function).parameters
    assert new in known
    assert old not in known
    taken = rename_arguments(**function.renamed_arguments)(lambda **options: options)
    with pytest.warns(DeprecationWarning, match=rf"{old}=\.\.\.\) → .*{new}=\.\.\.\)$"):
        assert taken(**{old: 1}) == {new: 1}


def test_a_radar_that_is_moved_is_one_that_is_transformed():
    turn = iw.scene.rotation_from_vector(torch.tensor([0.1, 0.2, 0.3]).double())
    shift = torch.tensor([0.3, 0.2, 0.1]).double()
    device: Any = radar()
    with pytest.warns(
        DeprecationWarning, match=r"Radar\.moved → Radar\.transform_rigidly$"
    ) as told:
        old = device.moved(turn, shift)
    if not os.environ.get("INVERTWIN_CHECK_TYPES"):  # whose wrappers stand between
        assert told[0].filename == __file__
    new = radar().transform_rigidly(turn, shift)
    assert torch.equal(old.positions, new.positions)
    assert torch.equal(old.rotations, new.rotations)


def test_a_constructor_a_copy_and_a_class_method_know_old_names():
    plane: dict[str, Any] = {"low": [0.0, 0.0], "high": [1.0, 1.0], "height": 1.0}
    menu: Any = iw
    with pytest.warns(
        DeprecationWarning, match=r"MapPlane\.horizontal\(cell=\.\.\.\) → .*cell_size"
    ):
        cells = menu.links.MapPlane.horizontal(**plane, cell=0.5)
    settings = iw.links.PropagationSettings(3.5e9)
    with pytest.warns(DeprecationWarning, match=r"RadioMap\(reception=\.\.\.\) → RadioMap\(propag"):
        old = menu.RadioMap(cells, reception=settings)
    assert (old.places, old.propagation) == (cells, settings)
    assert [x.name for x in fields(old)][:2] == ["places", "propagation"]
    assert list(inspect.signature(iw.RadioMap).parameters)[:2] == ["places", "propagation"]
    assert pickle.loads(pickle.dumps(old)).propagation.frequency == settings.frequency
    other = iw.links.PropagationSettings(2.4e9)
    with pytest.warns(DeprecationWarning, match=r"RadioMap\(reception=\.\.\.\)"):
        assert replace(old, reception=other).propagation == other
    with pytest.warns(DeprecationWarning, match=r"TabulatedPattern\.of_decibels → "):
        table = menu.scene.TabulatedPattern.of_decibels
    assert table == iw.scene.TabulatedPattern.from_decibels


def test_a_function_knows_old_arguments_and_shows_new_ones():
    inversion: Any = iw.inversion
    names = list(inspect.signature(iw.gradcheck).parameters)
    assert names[names.index("acts_on") + 1] == "settings"
    with pytest.warns(DeprecationWarning, match=r"remesh\(edge=...\) → remesh\(edge_length=...\)$"):
        old = inversion.remesh(iw.box(0.2), edge=0.1)
    assert torch.equal(old.vertices, iw.inversion.remesh(iw.box(0.2), 0.1).vertices)


def test_members_of_subclasses_come_before_old_names():
    class Base:
        def new(self) -> str:
            return "new"

    rename_members(Base, old="new", place="new")

    @dataclass
    class Mine(Base):
        place: int
        size: int

        def old(self) -> str:
            return "own"

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mine = Mine(1, 2)
        assert (mine.old(), mine.place) == ("own", 1)


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
    options: dict[str, Any] = {"directions": [[1.0, 0.0, 0.0]], "frequencies": [10e9]}
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
