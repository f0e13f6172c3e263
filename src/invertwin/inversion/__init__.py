"""Inversion: observations, losses, schedules, fits, confidence and gradient checks."""

from invertwin.deprecation import rename_attributes
from invertwin.inversion.callbacks import Checkpoint as Checkpoint
from invertwin.inversion.callbacks import Report as Report
from invertwin.inversion.callbacks import Watch as Watch
from invertwin.inversion.callbacks import report_progress as report_progress
from invertwin.inversion.confidence.planning import plan_error_bars as plan_error_bars
from invertwin.inversion.confidence.uncertainty import Uncertainty as Uncertainty
from invertwin.inversion.confidence.verdict import Verdict as Verdict
from invertwin.inversion.distributed import mean_over_views as mean_over_views
from invertwin.inversion.fit import Callback as Callback
from invertwin.inversion.fit import Fit as Fit
from invertwin.inversion.gradcheck.gradcheck import GradcheckSettings as GradcheckSettings
from invertwin.inversion.gradcheck.gradcheck import GradientAgreement as GradientAgreement
from invertwin.inversion.gradcheck.gradcheck import GradientReport as GradientReport
from invertwin.inversion.gradcheck.lines import evaluate_losses as evaluate_losses
from invertwin.inversion.gradcheck.lines import make_line as make_line
from invertwin.inversion.gradcheck.tangents import GaussianBump as GaussianBump
from invertwin.inversion.initialisation.initial_pose import InitialEstimate as InitialEstimate
from invertwin.inversion.initialisation.initial_pose import (
    InitialPoseEstimator as InitialPoseEstimator,
)
from invertwin.inversion.initialisation.multi_start import Screening as Screening
from invertwin.inversion.initialisation.multi_start import Search as Search
from invertwin.inversion.initialisation.multi_start import pose_grid as pose_grid
from invertwin.inversion.initialisation.multi_start import search as search
from invertwin.inversion.initialisation.starts import place_at_poses as place_at_poses
from invertwin.inversion.initialisation.starts import sample_nearby_poses as sample_nearby_poses
from invertwin.inversion.loss import CorrelationLoss as CorrelationLoss
from invertwin.inversion.loss import SpectrumLoss as SpectrumLoss
from invertwin.inversion.loss import speckle_divergence as speckle_divergence
from invertwin.inversion.loss import speckle_weight as speckle_weight
from invertwin.inversion.metrics import PoseError as PoseError
from invertwin.inversion.metrics import ShapeMetrics as ShapeMetrics
from invertwin.inversion.metrics import TopologyCounts as TopologyCounts
from invertwin.inversion.metrics import compare_shapes as compare_shapes
from invertwin.inversion.metrics import count_topology as count_topology
from invertwin.inversion.metrics import pose_error as pose_error
from invertwin.inversion.metrics import volume_iou as volume_iou
from invertwin.inversion.observation import Observation as Observation
from invertwin.inversion.observation import Unknown as Unknown
from invertwin.inversion.optimizer import Optimizer as Optimizer
from invertwin.inversion.reconstruction import Reconstruction as Reconstruction
from invertwin.inversion.reconstruction import prepare_fit as prepare_fit
from invertwin.inversion.reconstruction import reconstruct as reconstruct
from invertwin.inversion.regularization import Laplacian as Laplacian
from invertwin.inversion.regularization import LatentNorm as LatentNorm
from invertwin.inversion.regularization import Regularizer as Regularizer
from invertwin.inversion.schedule import Schedule as Schedule
from invertwin.inversion.schedule import Stage as Stage
from invertwin.scene.remeshing import remesh as remesh
from invertwin.scene.remeshing import require_edge_length as require_edge_length
from invertwin.scene.scene import displace as displace

rename_attributes(__name__)
