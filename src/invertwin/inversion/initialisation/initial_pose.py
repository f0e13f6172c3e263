"""Initial pose of an object by conventional processing."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Literal

from annotated_types import Gt, Lt
from jaxtyping import Float64
from torch import Tensor

from invertwin.capture import Capture
from invertwin.channel import Grid
from invertwin.errors import InputError
from invertwin.inversion.initialisation import detections
from invertwin.limits import Positive
from invertwin.radar.surrogate.surrogate import Surrogate
from invertwin.scene import Scale, Scene, rigid

# Wide enough for an error of a cell, narrow enough to distinguish front from back.
_POSE_SURROGATE = Surrogate(range_width=1.0, angle_width=0.5)


@dataclass(frozen=True)
class InitialEstimate:
    """Scene with an object at its estimated pose.

    Attributes:
        scene: scene with the object at its estimated pose.
        detection_count: number of echoes used.
        losses: losses of the candidate poses, if there are several.
        rectangle_size: size of the fitted rectangle around the echoes [m], if any.
    """

    scene: Scene
    detection_count: int = 0
    losses: list[float] = field(default_factory=list)
    rectangle_size: tuple[float, float] | None = None


@dataclass(frozen=True)
class InitialPoseEstimator:
    """Settings of the initial pose of an object by conventional processing.

    Attributes:
        low: corner of the search box in the world [m]; required unless the pose is known
        high: opposite corner [m]
        method: points = CFAR detections; image = backprojected power
        pose: estimated attitude: near sides of a rectangle, principal axes, position only, or known
            pose with an unknown density
        scale: whether the size is estimated from the rectangle
        false_alarm: false-alarm probability of a cell, for points
        step: node spacing of the image [m]
        gap: maximum gap between echoes of one object [m]

    Raises:
        InputError: A box that is missing, or not needed.
    """

    low: Float64[Tensor, "3"] | None = None
    high: Float64[Tensor, "3"] | None = None
    method: Literal["points", "image"] = "points"
    pose: Literal["rectangle", "axes", "position", "known"] = "rectangle"
    scale: bool = False
    false_alarm: Annotated[float, Gt(0), Lt(1)] = 1e-6
    step: Positive = 0.1
    gap: Positive = 1.0

    def __post_init__(self) -> None:
        for name in ("low", "high"):
            if (getattr(self, name) is None) != (self.pose == "known"):
                no, do = ("no ", "remove it") if self.pose == "known" else ("", "add it")
                got = "one" if self.pose == "known" else "none"
                raise InputError(
                    f'expected {no}`{name}` with pose = "{self.pose}", got {got}; {do}'
                )

    def estimate(
        self,
        scene: Scene,
        name: str,
        capture: Capture,
        grid: Grid,
        *,
        loss: Callable[[Tensor, Tensor], Tensor],
        seed: int = 0,
    ) -> InitialEstimate:
        """Estimate the pose of an object from its echoes.

        Args:
            scene: scene with the object at any pose.
            name: name of the object.
            capture: recorded data.
            grid: bins of its maps.
            loss: loss for the selection among several poses.
            seed: seed of their simulation.

        Raises:
            InputError: No echoes, or too few points.
        """
        if self.low is None or self.high is None:
            return InitialEstimate(scene)
        where = capture, grid, self.low, self.high
        if self.method == "points":
            points = detections.detect_echoes(*where, false_alarm=self.false_alarm)
        else:
            points = detections.find_bright_nodes(*where, step=self.step)
        points = detections.find_largest_group(points, self.gap)
        item, radar = scene[name], capture.radar()
        if self.pose == "position":
            shift = detections.estimate_position(points) - item.center.detach()
            shift[2] = 0.0
            moved = rigid(translation=shift) @ item.transform
            return InitialEstimate(scene.replace(name, pose=moved), len(points))
        if self.pose == "axes":
            rectangle = detections.principal_rectangle(points)
        else:
            cell = radar.waveform.range_resolution
            rectangle = detections.fit_rectangle(points, radar, resolution=cell)
        if self.scale:
            scale = Scale(name, detections.estimate_scale(item, rectangle))
            scene = scale.requires_grad_(False)(scene)
        poses = detections.candidate_poses(scene[name], rectangle, radar)
        scene, losses = detections.select_pose(
            scene, name, poses, radar, capture, grid,
            loss=loss, surrogate=_POSE_SURROGATE, seed=seed,
        )  # fmt: skip
        return InitialEstimate(scene, len(points), losses, rectangle.size)
