"""Automatic reconstruction of a recording, without an initial guess."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor
from torch.nn.functional import normalize, pad

from invertwin.capture import Capture, ChirpCapture
from invertwin.channel import Grid, ViewpointScene
from invertwin.checks import checked_count, checked_number, checked_tensor
from invertwin.constants import read_table
from invertwin.discovery import certainty
from invertwin.discovery.assembly import ShapeLikelihood, make_sampling
from invertwin.discovery.imaging import likelihood as likelihoods
from invertwin.discovery.imaging import point_detections
from invertwin.discovery.imaging.reflectivity import compute_response
from invertwin.discovery.outcome import DetectedObject, GroundImage, Twin
from invertwin.discovery.search import ImageGrid, ShapeSearch
from invertwin.discovery.self_calibration import calibrate_on_scene, phase_spread
from invertwin.discovery.shapes.outlines import fit_outlines
from invertwin.discovery.shapes.primitives import Shapes, shape_center
from invertwin.discovery.tracks import track_moving_targets
from invertwin.errors import InputError
from invertwin.inversion.callbacks import defer_interrupt
from invertwin.inversion.fingerprint import Fingerprint
from invertwin.models.radar import SurrogateMap
from invertwin.radar import Radar, SampledWaveform
from invertwin.radar.aperture import aperture
from invertwin.scene import Scene

_MARGIN_CELLS = 10  # range cells searched beyond the last echo, and beyond the region
_LEAKAGE_CELLS = 4  # range cells with leakage from transmitters to receivers
_DEFAULT_RADAR_HEIGHT = 0.6  # default height of radars above the ground [m]
_FEW_CHANNELS = 4  # along an axis of the array, whose maps have no taper
_FINAL_FIT_STEPS = 50  # steps of the final fit
_MAX_IMAGE_POINTS = 40_000  # maximum number of points of an image
_MIN_STATED_PROBABILITY = 0.05  # of another place of an object
_OTHER_PLACE = 0.5  # m, more than hypotheses of one place are apart
_HELD_OUT_EVERY = 4  # every fourth frame is held out, where there are twice as many
_Corner = Sequence[float] | None  # x and y [m]; None = all that is seen


def twin(
    recording: Capture | ChirpCapture,
    *,
    low: _Corner = None,
    high: _Corner = None,
    range_max: float | None = None,
    level: float | None = None,
    height: float | None = None,
    rays: int = 2000,
    seed: int = 0,
    checkpoint: str | Path | None = None,
) -> Twin:
    """Reconstruct the objects in a recording without an initial guess, with uncertainties.

    A maximum-likelihood reflectivity image locates echoes. Groups of bright points become shapes on
    the ground; all shapes are fitted jointly, and model evidence selects their kinds, mergers and
    deaths. In recordings of one channel along a dense track, points are detected where echoes add
    coherently. In chirp trains, moving targets are detected too, and tracked over three frames or
    more with a known frame period. If several positions reveal phase errors of the channels, they
    are calibrated first.

    Args:
        recording: recording of radars at known positions.
        low, high: opposite corners of the search region on the ground, x and y [m]; None = the
            whole visible region.
        range_max: maximum range [m]; None = the last range with echoes.
        level: height of the ground [m]; None = 0.6 m below the radars.
        height: height of the image above the ground [m]; None = that of the radars. Echoes come
            from about this height if objects are as tall as the radars; state less for lower
            objects.
        rays: number of rays per frame in fits.
        seed: seed of the rays.
        checkpoint: file of a search that is interrupted. Ctrl-C in the search of shapes then
            writes it and returns the likeliest objects so far; where it exists, the search goes
            on from it. A second Ctrl-C ends at once.

    Raises:
        InputError: A region invisible to all radars, or too large for its resolution; a checkpoint
            of another search.
    """
    checked_count(rays, "rays", 100)
    if isinstance(recording, ChirpCapture):
        recording = recording.merge_single_ramps()
    capture = average_chirps(recording)
    array = aperture(capture.radar())
    if max(len(array.y), len(array.z)) <= _FEW_CHANNELS:
        # A taper would leave two of four channels, and one of three: no direction.
        capture = Capture(capture.dataset.assign_attrs(array_window="rectangular"))
    if isinstance(recording, ChirpCapture) and recording.real:
        range_max = min(range_max or math.inf, recording.max_range)
    radar = capture.radar()
    base = float(radar.positions.detach()[:, 2].mean())
    floor = base - _DEFAULT_RADAR_HEIGHT if level is None else level
    floor = checked_number(floor, "level of the ground [m]", -math.inf)
    image_height = base if height is None else floor + checked_number(height, "height [m]", 0.0)
    reach = _search_range(capture, range_max)
    if isinstance(reach, str):
        moving = _find_moving_targets(recording, range_max)
        begin = "nothing that stands still" if moving else "nothing"
        return Twin(_sort_objects(moving), floor, notes=(begin + reach,))
    places, step = image_points(radar, image_height, reach, low, high)
    gains = calibrate_on_scene(capture, radar.grid(*reach), places)
    if gains is not None:
        recording, capture = gains.apply(recording), gains.apply(capture)
    moving = _find_moving_targets(recording, range_max)
    if point_detections.is_dense_track(capture):
        far = torch.cdist(places, radar.positions.detach())
        # Average over frames, where all of them have an echo.
        places = places[(far.amin(1) > reach[0]) & (far.amax(1) < reach[1])]
        separation = 4 * max(step, radar.waveform.wavelength)
        found, image = point_detections.locate_coherent_points(capture, places, separation)
        picture = GroundImage(places[:, :2], image, _count_views(radar, places, None))
        return Twin(_sort_objects([*found, *moving]), floor, picture)
    grid = radar.grid(reach[0], min(reach[1], _find_farthest_range(radar, places, floor)))
    search, one = _prepare_search(capture, grid, floor, places, step, rays, seed)
    still = _find_static_objects(capture, search, one, places, checkpoint)
    notes = () if gains is None else (_NOTES["calibration"].format(phase_spread(gains, radar)),)
    resting = [one for one in still.objects if one.shape or not _is_moving(one, moving)]
    objects = _sort_objects([*resting, *moving])
    return replace(still, objects=objects, notes=(*notes, *still.notes), calibration=gains)


def _find_farthest_range(radar: Radar, places: Tensor, floor: float) -> float:
    """Return the range [m] beyond which echoes are of nothing that stands in a region.

    Later echoes arrive by way of walls.
    """
    across = float(torch.cdist(places, radar.positions.detach()).max())
    down = float(radar.positions.detach()[:, 2].mean()) - floor
    return math.hypot(across, down) + _MARGIN_CELLS * radar.waveform.range_resolution


def average_chirps(recording: Capture | ChirpCapture) -> Capture:
    """Average the chirps of each frame, which attenuates moving targets.

    The mean over chirps has a Hann window. If the radar itself moves by a quarter of a wavelength
    or more within a frame, one chirp is used.

    Args:
        recording: recording of any kind.
    """
    if isinstance(recording, Capture):
        return recording
    chirps, radar = recording.chirps, recording.radar()
    lasts = float(chirps.times(radar.shape[1])[-1].max())
    path_length = float(point_detections.platform_velocities(recording).norm(dim=1).max()) * lasts
    if path_length > 0.25 * radar.waveform.wavelength:
        return recording.to_capture(chirps.count // 2)
    # At 2.5 bins of range rate a plain mean passes 1.7 % of the power, this one 0.05 %.
    window = torch.hann_window(chirps.count + 2, periodic=False, dtype=recording.beat.real.dtype)
    window = window[1:-1]
    weights = (window / window.mean())[:, None, None, None]
    return replace(recording, beat=recording.beat * weights, moving=False).to_capture()


def _find_moving_targets(
    recording: Capture | ChirpCapture, range_max: float | None
) -> list[DetectedObject]:
    """Detect moving targets in chirp trains, and track them if the frame period is known."""
    if isinstance(recording, Capture) or recording.chirps.count == 1:
        return []
    radar = recording.radar()
    near = _LEAKAGE_CELLS * radar.waveform.range_resolution
    grid = radar.grid(near, min(range_max or math.inf, recording.max_range))
    if recording.frame_period is not None and recording.frame_count > 2:
        return track_moving_targets(recording, grid)
    return point_detections.detect_moving_targets(recording, grid)


_NOTES = read_table("invertwin.discovery", "notes.toml")


def _prepare_search(
    capture: Capture, grid: Grid, level: float, positions: Tensor, step: float, rays: int, seed: int
) -> tuple[ShapeSearch, ShapeLikelihood]:
    """Return the search of a recording, and the likelihood of all its frames."""
    power = capture.spectrum(grid).detach().float()
    radar, frames = capture.radar(), capture.frame_count
    model = SurrogateMap(grid, sampling=make_sampling(frames, rays))
    loss = likelihoods.HeavyTailedLoss(_estimate_background(power, radar, grid))
    draw = likelihoods.count_bins_per_draw(likelihoods.map_axes(radar, grid))
    one = ShapeLikelihood(model, radar, power, loss, draw, level, seed)
    held = list(range(_HELD_OUT_EVERY - 1, frames, _HELD_OUT_EVERY))
    held = held if frames >= 2 * _HELD_OUT_EVERY else []
    fitted = one.select_frames([k for k in range(frames) if k not in held]) if held else one
    response = compute_response(fitted.radar, fitted.coarse_maps.grid, positions)
    height = max(float(positions[:, 2].mean()) - level, 0.1)
    lattice = ImageGrid(positions[:, :2], step, response, height)
    return ShapeSearch(fitted, one.select_frames(held) if held else None, lattice), one


def _find_static_objects(
    capture: Capture,
    search: ShapeSearch,
    one: ShapeLikelihood,
    positions: Tensor,
    checkpoint: str | Path | None,
) -> Twin:
    """Find the shapes that fit the maps of a recording, or until Ctrl-C the likeliest so far."""
    memory, sampling = one.memory, one.model.sampling
    fingerprint = Fingerprint(one.power, one.level, one.seed, sampling, positions)
    if checkpoint is not None and Path(checkpoint).exists():
        memory.load(Path(checkpoint), fingerprint)
    try:
        with defer_interrupt() as memory.heed:
            shapes, objects, notes = _search_shapes(capture, search, one, positions)
        stopped = False
    except KeyboardInterrupt:
        if checkpoint is None:
            raise
        memory.heed, stopped = lambda: None, True
        memory.save(Path(checkpoint), fingerprint)
        shapes, notes = search.best_so_far(), (_NOTES["stopped"],)
        sole = [[certainty.ShapeHypothesis(shape, 1.0)] for shape in shapes]
        objects = _describe_objects(one, {}, shapes, sole)
    scene, grid = one.build_scene(shapes) if shapes else None, one.model.grid
    views = _count_views(one.radar, positions, scene)
    seen = GroundImage(positions[:, :2], search.first_image, views)
    predicted = one.predict(shapes) + one.loss.level[:, None, None].to(one.power)
    return Twin(objects, one.level, seen, predicted, one.power, grid, notes, stopped=stopped)


def _search_shapes(
    capture: Capture, search: ShapeSearch, one: ShapeLikelihood, positions: Tensor
) -> tuple[Shapes, tuple[DetectedObject, ...], tuple[str, ...]]:
    """Search for shapes; return them, the objects that they are, and remarks."""
    fitted, aside, grid = search.fitted_frames, search.held_out_frames, one.model.grid
    shapes, points = search.run(), tuple(point_detections.detect_static_points(capture, grid))
    if capture.frame_count == 1:
        # Of one view a blurred echo has many outlines: the search may end in a wrong one.
        spheres = search.fit_spheres(one.position for one in points)
        shapes = max(shapes, spheres, key=search.evidence)
    if not shapes:
        nothing_found = "nothing" + _relate_to_noise(one.power, one.radar, grid)[2]
        return [], points, (_NOTES["no_shape"] if points else nothing_found,)
    notes = ()
    if aside is not None:
        shapes = fit_outlines(fitted, aside, shapes)
        there = aside.coarse_maps
        seen_there = compute_response(aside.radar, there.grid, positions)
        powers = torch.zeros_like(there.power), seen_there.predict_maps(search.first_image)
        nothing, image = (there.loss.bin_losses(power, there.power) for power in powers)
        draw = likelihoods.count_bins_per_draw(likelihoods.map_axes(aside.radar, there.grid))
        if float((nothing - image).sum()) / draw > aside.total_gain(shapes):
            notes = (_NOTES["image_better"],)
    shapes, found = one.fit(shapes, _FINAL_FIT_STEPS)
    among = certainty.find_hypotheses(one, shapes)
    likelier = [max(row, key=lambda one: one.probability).shape for row in among]
    if any(new is not old for new, old in zip(likelier, shapes, strict=True)):
        shapes, found = one.fit(likelier, _FINAL_FIT_STEPS)
        among = certainty.find_hypotheses(one, shapes)
    errors = certainty.standard_deviations(one, found)
    notes += tuple(_state_other_places(among))
    return shapes, _describe_objects(one, errors, shapes, among), notes


def _state_other_places(among: Sequence[certainty.Hypotheses]) -> Iterator[str]:
    """State where else an object may be if its hypotheses lie apart from its likeliest place."""
    for number, (first, *others) in enumerate(among, 1):
        here = first.shape.position
        far = [one for one in others if math.dist(one.shape.position, here) > _OTHER_PLACE]
        share = sum(one.probability for one in far)
        if share > _MIN_STATED_PROBABILITY:
            place = max(far, key=lambda one: one.probability).shape.position
            yield _NOTES["other_place"].format(number, share, *place)


def _describe_objects(
    likelihood: ShapeLikelihood,
    errors: Mapping[str, float],
    shapes: Shapes,
    among: Sequence[certainty.Hypotheses],
) -> tuple[DetectedObject, ...]:
    """Return fitted shapes as objects with error bars, kinds and existence probabilities."""
    found, present = [], certainty.existence_probabilities(likelihood, shapes)
    for k, (shape, own, probability) in enumerate(zip(shapes, among, present, strict=True), 1):
        name, kinds, start = f"object_{k}", certainty.kind_probabilities(own), f"object_{k}."
        center = shape_center(shape, likelihood.level)
        mine = {n.removeprefix(start): v for n, v in errors.items() if n.startswith(start)}
        wide = certainty.widen_deviations(likelihood, mine, own) if mine else {}
        kind = shape.effective_kind
        found.append(DetectedObject(name, kind, kinds, center, shape, wide, probability))
    return tuple(found)


def _is_moving(point: DetectedObject, moving: Sequence[DetectedObject]) -> bool:
    """Return whether a point lies within 3 standard deviations of a target that moves, which leaves
    some of its power in the mean of a frame's chirps.
    """
    places = [one.position if one.track is None else one.track.positions[0] for one in moving]
    reach = 3 * math.hypot(*point.deviations.values())
    return any((point.position - place).norm() < reach for place in places)


def _sort_objects(things: list[DetectedObject]) -> tuple[DetectedObject, ...]:
    """Sort objects by existence probability, moving ones last."""
    things = sorted(things, key=lambda one: (one.velocity is not None, -one.existence_probability))
    return tuple(things)


def _search_range(capture: Capture, range_max: float | None) -> tuple[float, float] | str:
    """Return the ranges from the end of the leakage to just beyond the last echo [m]; without
    echoes, a note that says what was searched.

    Args:
        capture: the recording.
        range_max: maximum range [m]; None = all.
    """
    radar = capture.radar()
    waveform, cell = radar.waveform, radar.waveform.range_resolution
    first = _LEAKAGE_CELLS * cell
    if isinstance(waveform, SampledWaveform):
        # The last cells of a period hold leakage of its first cells.
        longest = 0.98 * waveform.max_range
    else:
        first = max(first, float(capture.ranges[0]) + cell)
        longest = float(capture.ranges[-1]) - cell
    limit = longest if range_max is None else min(range_max, longest)
    if not first < limit:
        problem = f"expected range_max beyond the leakage, which ends at {first:.3g} m"
        raise InputError(f"{problem}, got {limit:.3g}; give a larger one")
    grid = radar.grid(first, limit)
    power = capture.spectrum(grid).detach().double()
    strongest, chance, note = _relate_to_noise(power, radar, grid)
    loud = (strongest > chance).nonzero()[:, 0]
    if not len(loud):
        return note
    return first, min(limit, float(grid.ranges[loud[-1]]) + _MARGIN_CELLS * cell)


def _relate_to_noise(power: Tensor, radar: Radar, grid: Grid) -> tuple[Tensor, float, str]:
    """Return the strongest bin of each range over the noise, what chance reaches, and a note."""
    # Noise level: a running minimum over range.
    strongest = power.amax((0, 2, 3)).double()
    strongest = strongest / float(_estimate_background(power, radar, grid).min())
    chance = 2 * math.log(power.numel()) + 5
    levels = (10 * math.log10(level) for level in (float(strongest.max()), chance))
    places = (float(grid.ranges[k]) for k in (0, -1, int(strongest.argmax())))
    return strongest, chance, _NOTES["no_signal"].format(*places, *levels)


def _estimate_background(power: Tensor, radar: Radar, grid: Grid) -> Tensor:
    directions = likelihoods.count_bins_per_draw(likelihoods.direction_axes(radar, grid))
    return likelihoods.estimate_background(power, directions)


def image_points(
    radar: Radar, height: float, ranges: tuple[float, float], low: _Corner, high: _Corner
) -> tuple[Float64[Tensor, "point 3"], float]:
    """Return visible image points on the ground [m], and their distance.

    Args:
        radar: radar with its positions.
        height: z of the points [m].
        ranges: smallest and largest distance from a radar position [m].
        low, high: opposite corners of the region, x and y [m]; None = as far as the ranges.

    Raises:
        InputError: corners in the wrong order, or a region that no radar sees.
    """
    at = radar.positions.detach()[:, :2]
    corners = [at.amin(0) - ranges[1], at.amax(0) + ranges[1]]
    for k, given in enumerate((low, high)):
        if given is not None:
            corners[k] = checked_tensor(given, (2,), "corner of the region [m]", "give two numbers")
    size = corners[1] - corners[0]
    if not bool((size > 0).all()):
        problem = f"expected low below high, got {corners[0].tolist()} and {corners[1].tolist()}"
        raise InputError(f"{problem}; give opposite corners of the region")
    cell = radar.waveform.range_resolution
    while True:
        counts = [max(2, math.ceil(float(side) / cell) + 1) for side in size]
        steps = [cell * torch.arange(count, dtype=torch.float64) for count in counts]
        flat = torch.cartesian_prod(corners[0][0] + steps[0], corners[0][1] + steps[1])
        places = pad(flat, (0, 1), value=height)
        near = torch.zeros(len(flat), dtype=torch.bool)
        for place, axis in _boresights(radar):
            way = places - place
            distance = way.norm(dim=1)
            near |= (way @ axis > 0.05 * distance) & (distance > ranges[0]) & (distance < ranges[1])
        if int(near.sum()) <= _MAX_IMAGE_POINTS:
            break
        cell *= 1.25
    if not bool(near.any()):
        raise InputError("expected a region that some radar sees, got none; check low and high")
    return places[near], cell


def _count_views(radar: Radar, positions: Tensor, scene: Scene | None) -> Tensor:
    """Count the radar positions that see each point past all objects."""
    total = torch.zeros(len(positions), dtype=torch.int64)
    for place, axis in _boresights(radar):
        way = positions - place
        seen = way @ axis > 0
        if scene is not None:
            sight = ViewpointScene(scene, place)
            face = sight.find_first_faces(way)
            seen &= sight.plane_distances(face, normalize(way, dim=1)) > way.norm(dim=1)
        total += seen
    return total


def _boresights(radar: Radar) -> list[tuple[Tensor, Tensor]]:
    """Return position and boresight of every frame."""
    axes = radar.link().rotations.detach()[:, :, 0]
    return list(zip(radar.positions.detach(), axes, strict=True))
