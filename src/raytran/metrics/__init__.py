# SPDX-License-Identifier: Apache-2.0
"""How good a prediction is: torchmetrics classes over pure functions in ``metrics.functional``."""

from raytran.metrics.atlas import ErrorAtlas
from raytran.metrics.curves import AccuracyCurves
from raytran.metrics.image import PSNR, SSIM
from raytran.metrics.new_views import NewViewScores
from raytran.metrics.odam import OrientedBoxF1
from raytran.metrics.scan2cad import Scan2CADAccuracy
from raytran.metrics.scene import ForegroundIoU, SceneOccupancyIoU
from raytran.metrics.shape import MatchedShapeScores

__all__ = [
    "PSNR",
    "SSIM",
    "AccuracyCurves",
    "ErrorAtlas",
    "ForegroundIoU",
    "MatchedShapeScores",
    "NewViewScores",
    "OrientedBoxF1",
    "Scan2CADAccuracy",
    "SceneOccupancyIoU",
]
