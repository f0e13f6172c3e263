"""Spectrum to loss to scene: reconstruction, and the check that its gradients are right."""

from invertwin.inversion.gradcheck import Agreement, Direction, GradientReport
from invertwin.inversion.loss import SpectrumLoss
from invertwin.inversion.measures import (
    Likeness,
    Topology,
    compare_shapes,
    topology,
    volume_iou,
)
from invertwin.inversion.mover import (
    Echo,
    MotionMap,
    MovingBody,
    fit_mover,
    motion_map,
    strongest_mover,
)
from invertwin.inversion.nuisances import ClockOffset, RangeBias
from invertwin.inversion.prior import LatentNorm
from invertwin.inversion.reconstruction import Optimizer, Reconstruction, reconstruct
from invertwin.inversion.regularization import Laplacian, Regularizer
from invertwin.inversion.remeshing import remeshed, signed_distance
from invertwin.inversion.stages import Stage, reconstruct_in_stages

__all__ = [
    "Agreement",
    "ClockOffset",
    "Direction",
    "Echo",
    "GradientReport",
    "Laplacian",
    "LatentNorm",
    "Likeness",
    "MotionMap",
    "MovingBody",
    "Optimizer",
    "RangeBias",
    "Reconstruction",
    "Regularizer",
    "SpectrumLoss",
    "Stage",
    "Topology",
    "compare_shapes",
    "fit_mover",
    "motion_map",
    "reconstruct",
    "reconstruct_in_stages",
    "remeshed",
    "signed_distance",
    "strongest_mover",
    "topology",
    "volume_iou",
]
