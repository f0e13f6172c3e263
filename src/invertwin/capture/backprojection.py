"""Images from range profiles by coherent summation, and calibration against a known target."""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Complex128, Float64
from scipy.optimize import minimize
from torch import Tensor

from invertwin.capture.capture import Capture
from invertwin.errors import InputError
from invertwin.radar.processing.backprojection import backproject_beat, pairwise_distances

# Half widths and steps of the first search: wide against what clocks and cables are off by after
# alignment by hand, dense against a range cell and the time in which a radar moves one beamwidth.
_CLOCK_SEARCH = (0.1, 0.01)
_BIAS_SEARCH = (0.1, 0.01)

FocusMeasure = Callable[[Tensor], Tensor]


def backproject(
    capture: Capture, points: Float64[Tensor, "*point 3"]
) -> Complex128[Tensor, "*point"]:
    """Focus the data on points: average the echoes from each point's distance over all frames.

    Echoes of a target at the point add in phase, since the profiles keep the phase of the carrier.
    This is the matched filter of a point target without its spreading loss. Beat samples go
    through ``backproject_beat``.

    Args:
        capture: range profiles or beat samples.
        points: world positions [m].

    Raises:
        InputError: a point is beyond the measured ranges.
    """
    if "beat" in capture.dataset:
        return backproject_beat(capture.beat, capture.radar(), points)
    flat = points.reshape(-1, 3)
    radar = capture.radar()
    ranges = pairwise_distances(radar.positions, flat) - radar.origins[:, None]
    return capture.interpolator()(ranges).mean(0).reshape(points.shape[:-1])


def locate(
    capture: Capture, center: Float64[Tensor, "3"], radius: float = 0.6, step: float = 0.01
) -> Float64[Tensor, "3"]:
    """Find the brightest point of the backprojected image in a horizontal square, along x and y.

    Args:
        capture: range profiles.
        center: middle of the square, at the known height of the target [m].
        radius: half the side of the square [m].
        step: pixel size of the image that starts the search [m]; below half a resolution cell.

    Raises:
        InputError: the capture holds beat samples, a point is beyond the measured ranges, or a step
            that is not positive and below the radius.
    """
    if not 0 < step < radius:
        raise InputError(f"expected 0 < step < radius, got {step} and {radius}; give metres")
    interpolator, radar = capture.interpolator(), capture.radar()

    def brightness(offset: Float64[Tensor, "point 2"]) -> Float64[Tensor, " point"]:
        points = center + torch.nn.functional.pad(offset, (0, 1))
        ranges = pairwise_distances(radar.positions, points) - radar.origins[:, None]
        return interpolator(ranges).mean(0).abs()

    spans = (radius, step), (radius, step)
    found = torch.tensor(_maximise_measure(brightness, spans), dtype=torch.float64)
    return center + torch.nn.functional.pad(found, (0, 1))


def calibrate(capture: Capture, target: Float64[Tensor, "3"]) -> Capture:
    """Find the clock offset and the range bias that focus a known target best.

    Both are searched within 0.1 s and 0.1 m of the present ones. The search maximises the power of
    the coherent sum. A bias turns all frames alike, so this power follows the envelope of the
    pulse, not its carrier. Over the clock offset the maximum is as sharp as the image.

    Args:
        capture: range profiles with the track of the radar.
        target: surveyed position [m].

    Raises:
        InputError: the capture has no track or holds beat samples, or the search leads outside
            the track or the measured ranges.
    """
    interpolator, origins = capture.interpolator(), capture.radar().origins[:, None]

    def focus(trial: Float64[Tensor, "trial 2"]) -> Float64[Tensor, " trial"]:
        """Amplitude at the target for rows of shifts of clock [s] and bias [m]."""
        ranges = [(capture.positions(clock) - target).norm(dim=1) for clock in trial[:, 0]]
        return interpolator(torch.stack(ranges, dim=1) - origins + trial[:, 1]).mean(0).abs()

    clock, bias = _maximise_measure(focus, (_CLOCK_SEARCH, _BIAS_SEARCH))
    return capture.recalibrate(capture.clock_offset + clock, capture.range_bias + bias)


def _maximise_measure(measure: FocusMeasure, spans: Sequence[tuple[float, float]]) -> list[float]:
    """The maximum of a measure of rows of two numbers: on a grid, then from there by a simplex.

    The spans are half the width and the step of the grid along each axis.
    """
    axes = [torch.arange(-half, half + step / 2, step, dtype=torch.float64) for half, step in spans]
    trials = torch.cartesian_prod(*axes)
    # A column of the grid at a time keeps the memory of frames × points small.
    values = torch.cat([measure(part) for part in trials.split(len(axes[1]))])
    x, y = trials[values.argmax()].tolist()
    simplex = [(x, y), (x + spans[0][1] / 2, y), (x, y + spans[1][1] / 2)]

    def loss(values) -> float:
        return -float(measure(torch.as_tensor(values, dtype=torch.float64)[None]).log())

    options = {"xatol": 1e-6, "fatol": 1e-12, "initial_simplex": simplex}
    return minimize(loss, (x, y), method="Nelder-Mead", options=options).x.tolist()
