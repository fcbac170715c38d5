# SPDX-License-Identifier: Apache-2.0
"""How good a prediction is: torchmetrics classes over pure functions in ``metrics.functional``."""

from raytran.metrics.accuracy_curves import AccuracyCurves
from raytran.metrics.average_precision import MeanAveragePrecision
from raytran.metrics.box_f1 import OrientedBoxF1
from raytran.metrics.error_atlas import ErrorAtlas
from raytran.metrics.new_views import PSNR, SSIM, NewViewScores
from raytran.metrics.occupancy_iou import ForegroundIoU, SceneOccupancyIoU
from raytran.metrics.scan2cad import Scan2CADAccuracy
from raytran.metrics.score_calibration import ScoreCalibration
from raytran.metrics.shape import MatchedShapeScores

__all__ = [
    "PSNR",
    "SSIM",
    "AccuracyCurves",
    "ErrorAtlas",
    "ForegroundIoU",
    "MatchedShapeScores",
    "MeanAveragePrecision",
    "NewViewScores",
    "OrientedBoxF1",
    "Scan2CADAccuracy",
    "SceneOccupancyIoU",
    "ScoreCalibration",
]
