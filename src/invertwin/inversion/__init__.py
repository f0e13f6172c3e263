"""Spectrum to loss to scene: reconstruction, and the check that its gradients are right."""

from invertwin.inversion.callbacks import Checkpoint, Report, Watch
from invertwin.inversion.fit import Callback, Fit
from invertwin.inversion.gradcheck import Agreement, Check, GradientReport
from invertwin.inversion.loss import CorrelationLoss, SpectrumLoss
from invertwin.inversion.metrics import (
    ShapeMetrics,
    Topology,
    compare_shapes,
    topology,
    volume_iou,
)
from invertwin.inversion.mover import Echo, MovingBody, of_point, strongest_mover
from invertwin.inversion.observation import Observation, Unknown
from invertwin.inversion.optimizer import Optimizer
from invertwin.inversion.prior import LatentNorm
from invertwin.inversion.reconstruction import Reconstruction, reconstruct
from invertwin.inversion.regularization import Laplacian, Regularizer
from invertwin.inversion.remeshing import remeshed, signed_distance
from invertwin.inversion.schedule import Schedule, Stage

__all__ = [
    "Agreement",
    "Callback",
    "Check",
    "Checkpoint",
    "CorrelationLoss",
    "Echo",
    "Fit",
    "GradientReport",
    "Laplacian",
    "LatentNorm",
    "MovingBody",
    "Observation",
    "Optimizer",
    "Reconstruction",
    "Regularizer",
    "Report",
    "Schedule",
    "ShapeMetrics",
    "SpectrumLoss",
    "Stage",
    "Topology",
    "Unknown",
    "Watch",
    "compare_shapes",
    "of_point",
    "reconstruct",
    "remeshed",
    "signed_distance",
    "strongest_mover",
    "topology",
    "volume_iou",
]
