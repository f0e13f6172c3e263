"""Fits in clutter: objects that the scene lacks are imaged, and count as background."""

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float64
from scipy.optimize import minimize_scalar
from torch import Tensor

from invertwin import inversion
from invertwin.discovery.imaging.likelihood import estimate_background
from invertwin.discovery.imaging.reflectivity import compute_response, reconstruct_reflectivity
from invertwin.discovery.recordings import image_points
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel
from invertwin.inversion.confidence.uncertainty import find_known_permittivities
from invertwin.inversion.observation import Unknown, Unknowns, name_unknowns
from invertwin.inversion.schedule import Schedule, make_stages
from invertwin.models import SurrogateMap, WhitenedMap
from invertwin.scene import MaterialValues, Object, Scene, signed_distance

# Clutter of more than this share of the fitted objects' power may be echoes of these objects, such
# as a letter with a wrong rotation.
_RIVAL_SHARE = 0.05
_SIGNIFICANT = 3.0  # standard deviations of a material value from the stated one
_LOG_SUSCEPTIBILITIES = -3.0, 4.0  # search for initial permittivities: 1.05 to 56
_INITIAL_LOBE = {"diffuse": 0.5, "lobe_width": 0.5}  # [rad]; without any, its width has no effect
_RESOLUTIONS = 2.0  # range resolutions about a fitted object that clutter leaves free, without blur


def reconstruct_among_clutter(
    scene: Scene,
    observations: inversion.Observation | Sequence[inversion.Observation],
    parameters: Unknowns,
    *,
    schedule: Schedule | Sequence[Schedule] | None = None,
    seed: int = 0,
    callbacks: Callable[[int], Sequence[inversion.Callback]] = lambda number: (),
    always: bool = True,
    **options: Any,
) -> inversion.Reconstruction:
    """Fit objects in clutter, the echoes of objects that the scene lacks.

    Unmodelled echoes are added as background, except around the fitted objects, see
    ``estimate_clutter``. A second fit, without blur, starts from the result of the first, with the
    clutter estimated there. If the result is inconsistent with the data, and the scene has objects
    that are not fitted, both fits are repeated with free permittivities of the fitted objects, see
    ``reconstruct_with_permittivities``.

    Args:
        scene: initial scene.
        observations: recordings of one or several radars, each with a ``SurrogateMap``.
        parameters: modules Scene → Scene, as for ``reconstruct``.
        schedule: schedule of each fit, or its stages; all frames in every step.
        seed: seed of all random numbers.
        callbacks: observers of each fit, given its number: 0 and 1, 2 and 3 with permittivities.
        always: False = only if the data contradict a fit without clutter and the same fits with
            free permittivities and with free lobes, if they contradict the first; the better fit is
            returned.
        options: further options of ``reconstruct``.

    Raises:
        InputError: as ``reconstruct``; a model other than a ``SurrogateMap``; random frames; new
            modules in a stage; no fitted object.
    """
    given = list(observations) if isinstance(observations, Sequence) else [observations]
    unknowns, plain = name_unknowns(parameters), None
    if not always:
        how: dict[str, Any] = {"schedule": schedule, "seed": seed, **options}
        plain = _fit_without_clutter(scene, given, unknowns, **how)
        if not needs_clutter(plain):
            return plain
    sensors = [name_unknowns(o.parameters, f"sensor{k}.") for k, o in enumerate(given)]
    stages = make_stages(schedule, [*unknowns, *(name for own in sensors for name in own)])
    if any(stage.frames_per_step is not None or stage.rebuilds_modules for stage in stages):
        problem = "expected all frames and the same parameters in every step"
        raise InputError(f"{problem}, got frames_per_step or a stage that rebuilds; leave them out")
    fit = inversion.prepare_fit(scene, given, unknowns)
    objects, present = fit.apply_modules()[0].objects, fit.twin()
    fitted = [name for name, item in objects.items() if item.vertices.requires_grad]
    if not fitted:
        problem = "expected a parameter that moves an object, away from clutter, got none"
        raise InputError(f"{problem}; give a Pose or a shape, or use reconstruct")

    def fit_rounds(unknowns: dict[str, Unknown], first: int) -> inversion.Reconstruction:
        """Fit among clutter about the start, and again, without blur, about the end."""
        about = present
        for number, blur in ((first, 1.0), (first + 1, 0.0)):
            blurred = [replace(o, model=o.model.scale_blur(blur)) for o in given]
            clutter = [estimate_clutter(about, o, fitted, seed=seed).background for o in blurred]
            whitened = _whiten([o.model for o in blurred], clutter)
            watched = [replace(o, model=model) for o, model in zip(given, whitened, strict=True)]
            models = [_whiten([m.scale_blur(blur) for m in s.models], clutter) for s in stages]
            plan = [replace(stage, models=m) for stage, m in zip(stages, models, strict=True)]
            how: Any = {"schedule": plan, "seed": seed, "callbacks": callbacks(number), **options}
            found = inversion.reconstruct(scene, watched, unknowns, **how)
            about, modules = found.scene, list(found.parameters)
            unknowns = {n: replace(own, module=modules.pop(0)) for n, own in unknowns.items()}
        return found

    again, found = copy.deepcopy(unknowns), fit_rounds(unknowns, 0)
    if needs_clutter(found):
        free = _free_materials(scene, given, again, seed=seed, **options)
        bright = fit_rounds(again | name_unknowns(free), 2) if free else found
        if any(_has_moved(bright, key, objects) for key in free):
            found = choose_result(found, bright)
    found = replace(found, doubts=tuple(_find_rivals(found.scene, given, fitted, seed)))
    return found if plain is None else choose_result(plain, found)


def _fit_without_clutter(
    scene: Scene, given: list[inversion.Observation], unknowns: dict[str, Unknown], **how: Any
) -> inversion.Reconstruction:
    """Fit copies of the parameters, with material values if the data are consistent with that."""
    plain = inversion.reconstruct(scene, given, copy.deepcopy(unknowns), **how)
    if needs_permittivities(plain):
        with suppress(InputError):  # the data do not determine material values
            for lobes in (False, True):
                own = copy.deepcopy(unknowns)
                found = reconstruct_with_permittivities(scene, given, own, lobes=lobes, **how)
                if not needs_clutter(found) and (not lobes or finds_lobes(found, scene)):
                    return found
    return plain


def reconstruct_with_permittivities(
    scene: Scene,
    observations: Sequence[inversion.Observation],
    parameters: Unknowns,
    *,
    lobes: bool = False,
    **options: Any,
) -> inversion.Reconstruction:
    """Fit objects together with their permittivities, which determine how bright they are.

    An object that is brighter in the model than in the data otherwise rotates its faces away from
    the radar, which it does at once: permittivities therefore start where the blurred maps of the
    initial scene are most likely.

    Args:
        scene: initial scene.
        observations: recordings.
        parameters: modules Scene → Scene, as for ``reconstruct``.
        lobes: fit diffuse shares and lobe widths of objects of a ``RoughDielectric``, too.
        options: further options of ``reconstruct``.

    Raises:
        InputError: as ``reconstruct``; all objects are fitted, which leaves the gain unknown, or no
            fitted object has a known permittivity, with ``lobes`` also a known lobe.
    """
    unknowns = name_unknowns(parameters)
    free = _free_materials(scene, observations, unknowns, lobes=lobes, **options)
    if not any("diffuse" in values.raw or not lobes for values in free.values()):
        known = f"known permittivity{' and lobe' if lobes else ''} beside one that is not fitted"
        raise InputError(f"expected a fitted object of {known}, got none; use reconstruct")
    return inversion.reconstruct(scene, observations, unknowns | name_unknowns(free), **options)


def _free_materials(
    scene: Scene,
    observations: Sequence[inversion.Observation],
    unknowns: Unknowns,
    *,
    lobes: bool = False,
    **options: Any,
) -> dict[str, MaterialValues]:
    """Return permittivities that determine how bright moved objects are, as unknowns.

    They start where the blurred maps of the initial scene are most likely, one after the other.
    """
    how = {key: options[key] for key in ("loss", "regularizers", "seed") if key in options}
    fit = inversion.prepare_fit(scene, observations, unknowns, **how)
    objects, values = fit.apply_modules()[0].objects, dict[str, MaterialValues]()
    for name, value in find_known_permittivities(objects).items():
        stated = [vars(objects[name].material).get(key) for key in _INITIAL_LOBE]
        is_known = lobes and all(isinstance(one, float) for one in stated)
        lobe: dict[str, Any] = _INITIAL_LOBE if is_known else {}
        values[f"{name}.permittivity"] = MaterialValues(name, permittivity=value, **lobe)
    fit = fit.copy(*values.values())
    for raw in [module.raw["permittivity"] for module in values.values()]:

        def loss(value: float, raw: Tensor = raw) -> float:
            with torch.no_grad():
                raw.fill_(value)
                return float(fit.evaluate(0))

        loss(minimize_scalar(loss, bounds=_LOG_SUSCEPTIBILITIES, options={"xatol": 0.1}).x)
    return values


def finds_lobes(found: inversion.Reconstruction, stated: Scene) -> bool:
    """True if a fitted diffuse share differs significantly from the stated one.

    Lobes that the data do not determine would only take up other errors of the model.

    Args:
        found: result of ``reconstruct_with_permittivities`` with ``lobes``.
        stated: initial scene.

    Raises:
        InputError: Error bars are not available.
    """
    shares = [name for name in found.uncertainty.names if name.endswith(".diffuse")]
    return any(_has_moved(found, share, stated.objects) for share in shares)


def _has_moved(found: inversion.Reconstruction, key: str, before: Mapping[str, Object]) -> bool:
    """Test whether a fitted material value differs significantly from the stated one.

    A value that the data do not determine would only take up clutter.
    """
    name, field = key.rsplit(".", 1)
    ends = (vars(objects[name].material)[field] for objects in (found.scene, before))
    return bool(abs(next(ends) - next(ends)) > _SIGNIFICANT * found.uncertainty.deviations[key])


def _find_rivals(
    scene: Scene, observations: Sequence[inversion.Observation], fitted: Sequence[str], seed: int
) -> Iterator[str]:
    """State where clutter is so bright that it may be echoes of the fitted objects."""
    for observation in observations:
        clutter = estimate_clutter(scene, observation, fitted, seed=seed)
        share = float(clutter.echoes.sum()) / _predict_power_of(fitted, scene, observation, seed)
        if share > _RIVAL_SHARE:
            place = ", ".join(f"{value:.2f}" for value in clutter.strongest_position.tolist())
            power = f"{min(share, 999.0):.2g} times the power of the fitted objects, strongest at"
            yield f"unmodelled echoes have {power} ({place}) m: they may be parts of these"


def _predict_power_of(
    fitted: Sequence[str], scene: Scene, observation: inversion.Observation, seed: int
) -> float:
    """Predict the power that objects add to a map, over all bins, > 0, in the recording's unit."""
    model, radar = observation.model.scale_blur(0.0), observation.initial_sensor()
    rest = {name: item for name, item in scene.objects.items() if name not in fitted}
    with torch.no_grad():
        predicted = model.predict(scene, radar, seed).clamp_min(0.0)
        own = predicted - model.predict(Scene(rest), radar, seed) if rest else predicted
    gain = inversion.SpectrumLoss().fitted_gain(predicted, observation.observed_map())
    return max(gain * float(own.clamp_min(0.0).sum()), 1e-300)


def _whiten(models: Sequence[ForwardModel], backgrounds: Sequence[Tensor]) -> list[WhitenedMap]:
    """Return models over backgrounds; none where a stage has no models of its own."""
    return [WhitenedMap(*pair) for pair in zip(models, backgrounds, strict=False)]


def needs_clutter(found: inversion.Reconstruction) -> bool:
    """True if the data are not consistent with a result, so that a fit among clutter may help."""
    return found.verdict.word in ("inconsistent", "worse", "at a bound")


def needs_permittivities(found: inversion.Reconstruction) -> bool:
    """True if the data contradict a result, or a permittivity that it holds."""
    if needs_clutter(found):
        return True
    with suppress(InputError):  # error bars may not be available
        return any(name.endswith(".permittivity") for name in found.uncertainty.contradicted)
    return False


def choose_result(
    plain: inversion.Reconstruction, among: inversion.Reconstruction
) -> inversion.Reconstruction:
    """Choose the better of two fits of the same data, without and among clutter.

    The second fit is chosen if the data are consistent with it, otherwise the fit with the lower
    loss with clutter.

    Args:
        plain: result of ``reconstruct``.
        among: result of ``reconstruct_among_clutter``.
    """
    if not needs_clutter(among):
        return among
    fit, losses = among.result.fit.copy(), []
    with torch.no_grad():
        for own in (plain.result.fit, among.result.fit):
            fit.scene, fit.unknowns = own.scene, own.unknowns
            fit.sensor_unknowns = own.sensor_unknowns
            losses.append(float(fit.objective(fit.unblurred_maps(0))))
    return among if losses[1] <= losses[0] else plain


@dataclass(frozen=True, eq=False)
class Clutter:
    """Mean power of noise and of unmodelled echoes.

    Attributes:
        noise: mean power of noise in a bin, in the unit of the recording.
        echoes: mean power of the echoes in every bin.
        positions: reflecting points [point, 3] [m].
        strengths: radar cross-sections of the points [m²], in the unit of the recording.
    """

    noise: float
    echoes: Float64[Tensor, "frame range u v"]
    positions: Float64[Tensor, "point 3"]
    strengths: Float64[Tensor, " point"]

    @property
    def background(self) -> Float64[Tensor, "frame range u v"]:
        """Mean power of noise and echoes in every bin."""
        return self.noise + self.echoes

    @property
    def strongest_position(self) -> Float64[Tensor, "3"]:
        """Position of the brightest point [m]."""
        return self.positions[self.strengths.argmax()]


def estimate_clutter(
    scene: Scene, observation: inversion.Observation, fitted: Sequence[str], *, seed: int = 0
) -> Clutter:
    """Estimate the mean power of noise and of unmodelled echoes.

    Unmodelled echoes are represented by isotropic points at the height of the fitted objects, with
    the maximum-likelihood reflectivity given the predicted power of the scene. Points within the
    range blur of the fitted objects are left out, so that clutter does not absorb the echoes of
    these.

    Args:
        scene: known scene, with the fitted objects at their present poses.
        observation: recording of a radar with a ``SurrogateMap``.
        fitted: names of the fitted objects.
        seed: seed of the predicted map.

    Raises:
        InputError: A model other than a ``SurrogateMap``.
    """
    model, radar = observation.model, observation.initial_sensor()
    if not isinstance(model, SurrogateMap):
        kind = type(model).__name__
        raise InputError(f"expected a SurrogateMap for clutter, got a {kind}; fit without")
    power = observation.observed_map()
    with torch.no_grad():
        predicted = model.scale_blur(0.0).predict(scene, radar, seed).clamp_min(0.0)
    law = inversion.SpectrumLoss()
    gain = law.fitted_gain(predicted, power)
    # The weakest range bin: a level fitted to the whole map would hold the clutter.
    noise = float(estimate_background(power).min()) + law.floor * float(power.mean())
    ranges = float(model.grid.ranges[0]), float(model.grid.ranges[-1])
    objects = [scene[name].world_mesh for name in fitted]
    height = float(torch.stack([mesh.center[2] for mesh in objects]).mean())
    points, _ = image_points(radar, height, ranges, None, None)
    margin = radar.waveform.range_resolution * max(_RESOLUTIONS, model.kernels.range_width)
    for mesh in objects:
        points = points[signed_distance(mesh, points) > margin]
    response = compute_response(radar, model.grid, points)
    known = (gain * predicted + noise).double()
    strengths = reconstruct_reflectivity(response, power.double(), known)
    return Clutter(noise, response.predict_maps(strengths), points, strengths)
