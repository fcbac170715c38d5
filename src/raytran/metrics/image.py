# SPDX-License-Identifier: Apache-2.0
"""How close images of new views are to photographs: torchmetrics' PSNR and SSIM, as means over the frames.

torchmetrics' own classes pool the squared error of all pixels, which is not the mean PSNR that the field
reports, and count scenes twice that a distributed sampler repeats.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

from raytran.errors import ShapeError
from raytran.metrics.records import RecordMetric, SceneRecord


class _FrameMean(RecordMetric):
    """Mean of a value over all frames of all scenes."""

    # One row for a frame: its value.
    truth_columns = 1
    prediction_columns = 0

    @abstractmethod
    def values(self, predicted: Tensor, target: Tensor) -> Tensor:
        """Return the value of each frame, float32 ``(N, 3, H, W)`` twice → ``(N,)``."""

    def update(self, predicted: Tensor, target: Tensor, scene_ids: Sequence[str]) -> None:
        """Compare the frames of scenes.

        Args:
            predicted: ``(B, N, 3, H, W)`` in [0, 1].
            target: ``(B, N, 3, H, W)`` in [0, 1].
            scene_ids: the name of each scene; all its frames are given at once.

        Raises:
            ShapeError: the shapes differ, or there are not as many names as scenes.
        """
        if predicted.ndim != 5 or predicted.shape != target.shape or len(scene_ids) != len(target):
            raise ShapeError(
                "expected predicted and true images (B, N, 3, H, W) with a name for each scene, got "
                f"{tuple(predicted.shape)}, {tuple(target.shape)} and {len(scene_ids)} names"
            )
        for name, *images in zip(scene_ids, predicted.float(), target.float(), strict=True):
            table = self.values(images[0], images[1]).detach().cpu().double()[:, None]
            self.keep(SceneRecord(name, table, table.new_zeros(0, self.prediction_columns)))

    def compute(self) -> Tensor:
        """Return the mean, a float64 scalar; NaN if no frame was seen."""
        values = [value for scene in self.scenes() for value in scene.truths.flatten().tolist()]
        return torch.tensor(math.fsum(values) / len(values) if values else math.nan, dtype=torch.float64)


class PSNR(_FrameMean):
    """Peak signal-to-noise ratio in decibels, ``-10 log10(mean squared error)``, mean over the frames.

    Args:
        **kwargs: see ``torchmetrics.Metric``.
    """

    def values(self, predicted: Tensor, target: Tensor) -> Tensor:
        """Return the PSNR of each frame; infinite where the images are equal."""
        return psnr_of_frames(predicted, target)


class SSIM(_FrameMean):
    """Structural similarity (Wang et al., 2004), mean over the frames.

    Gaussian window of σ 1.5 pixels; images are mirrored at the border.

    Args:
        **kwargs: see ``torchmetrics.Metric``.
    """

    def values(self, predicted: Tensor, target: Tensor) -> Tensor:
        """Return the SSIM of each frame, at most 1."""
        return ssim_of_frames(predicted, target)


def psnr_of_frames(predicted: Tensor, target: Tensor) -> Tensor:
    """Return the PSNR in decibels of each frame, float32 ``(N, 3, H, W)`` twice → ``(N,)``."""
    return peak_signal_noise_ratio(predicted, target, data_range=1.0, dim=(1, 2, 3), reduction="none")


def ssim_of_frames(predicted: Tensor, target: Tensor) -> Tensor:
    """Return the SSIM of each frame, float32 ``(N, 3, H, W)`` twice → ``(N,)``."""
    similarity = structural_similarity_index_measure(predicted, target, data_range=1.0, reduction="none")
    return cast("Tensor", similarity).reshape(len(predicted))  # torchmetrics drops the dimension of one
