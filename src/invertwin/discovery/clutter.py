"""Fits among things that the scene lacks: clutter is imaged, and counts as background."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.discovery.imaging.likelihood import estimate_background
from invertwin.discovery.imaging.reflectivity import compute_response, reconstruct_reflectivity
from invertwin.discovery.recordings import image_points
from invertwin.errors import InputError
from invertwin.inversion import Observation, Reconstruction, SpectrumLoss, prepare_fit, reconstruct
from invertwin.inversion.observation import Unknowns, name_unknowns
from invertwin.inversion.schedule import Schedule
from invertwin.models.radar import SurrogateMap
from invertwin.models.whitened import WhitenedMap
from invertwin.scene import Mesh, Scene, signed_distance

_RESOLUTIONS = 2.0  # range resolutions about a fitted object that clutter leaves free, without blur


def reconstruct_among_clutter(
    scene: Scene,
    observations: Observation | Sequence[Observation],
    parameters: Unknowns,
    *,
    schedule: Schedule | None = None,
    seed: int = 0,
    **options: Any,
) -> Reconstruction:
    """Fit objects among things that the scene lacks.

    Echoes that the scene does not explain count as background, except around the objects that are
    fitted, see ``estimate_clutter``. A second fit, without blur, starts from the result of the
    first, with the clutter about it.

    Args:
        scene: initial scene.
        observations: recordings of one or several radars, each with a ``SurrogateMap``.
        parameters: modules Scene → Scene, as for ``reconstruct``.
        schedule: schedule of each of the two fits, all frames in every step.
        seed: seed of all random numbers.
        options: further options of ``reconstruct``.

    Raises:
        InputError: As ``reconstruct``; another model; random frames; no object that moves.
    """
    given = [observations] if isinstance(observations, Observation) else list(observations)
    plan, unknowns = schedule or Schedule(), name_unknowns(parameters)
    if plan.frames_per_step is not None:
        raise InputError(
            f"expected all frames in every step, got frames_per_step = {plan.frames_per_step}: "
            "every frame has clutter of its own; leave it out"
        )
    fit = prepare_fit(scene, given, unknowns)
    objects, present = fit.apply_modules()[0].objects, fit.twin()
    fitted = [name for name, item in objects.items() if item.vertices.requires_grad]
    if not fitted:
        raise InputError(
            "expected a parameter that moves an object, got none: clutter is what is away from the "
            "fitted objects; give a Pose or a shape, or use reconstruct"
        )
    for blur in (1.0, 0.0):
        whitened = []
        for observation in given:
            model = observation.model.scale_blur(blur)
            clutter = estimate_clutter(
                present, replace(observation, model=model), fitted, seed=seed
            )
            whitened.append(replace(observation, model=WhitenedMap(model, clutter)))
        found = reconstruct(scene, whitened, unknowns, schedule=plan, seed=seed, **options)
        present, modules = found.scene, list(found.parameters)
        unknowns = {
            name: replace(unknown, module=modules.pop(0)) for name, unknown in unknowns.items()
        }
    return found


def estimate_clutter(
    scene: Scene, observation: Observation, fitted: Sequence[str], *, seed: int = 0
) -> Float64[Tensor, "frame range u v"]:
    """Estimate the mean power of noise and of echoes that a scene does not explain.

    The unexplained echoes are those of isotropic points at the height of the fitted objects, with
    the maximum-likelihood reflectivity given the scene's own power. Points near the fitted objects
    are left out, as far as the model blurs in range, so that clutter does not take their echoes.

    Args:
        scene: what is known, fitted objects at their present places.
        observation: recording of a radar with a ``SurrogateMap``.
        fitted: names of the fitted objects.
        seed: seed of the predicted map.

    Returns:
        Mean power in every bin, in the unit of the recording.

    Raises:
        InputError: Another model.
    """
    model, radar = observation.model, observation.initial_sensor()
    if not isinstance(model, SurrogateMap):
        raise InputError(
            f"expected a SurrogateMap for clutter, got a {type(model).__name__}; fit without"
        )
    power = observation.observed_map()
    with torch.no_grad():
        predicted = model.scale_blur(0.0).predict(scene, radar, seed).clamp_min(0.0)
    law = SpectrumLoss()
    gain = law.fitted_gain(predicted, power)
    # The weakest range bin: a level fitted to the whole map would hold the clutter.
    noise = float(estimate_background(power).min()) + law.floor * float(power.mean())
    ranges = float(model.grid.ranges[0]), float(model.grid.ranges[-1])
    objects = [Mesh(scene[name].vertices.detach(), scene[name].mesh.faces) for name in fitted]
    height = float(torch.stack([mesh.center[2] for mesh in objects]).mean())
    points, _ = image_points(radar, height, ranges, None, None)
    margin = radar.waveform.range_resolution * max(_RESOLUTIONS, model.kernels.range_width)
    for mesh in objects:
        points = points[signed_distance(mesh, points) > margin]
    response = compute_response(radar, model.grid, points)
    known = (gain * predicted + noise).double()
    return noise + response.predict_maps(reconstruct_reflectivity(response, power.double(), known))
