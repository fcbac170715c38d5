# SPDX-License-Identifier: Apache-2.0
"""How close rendered views are to photographs (RayTran appendix A): PSNR and SSIM, means over the views.

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
from raytran.geometry.camera import Cameras
from raytran.metrics.per_scene import Row, SceneMetric, SceneRecord
from raytran.structs import Views

_COLUMNS = ("psnr", "ssim", "psnr_best_constant", "psnr_nearest_frame")


class _FrameMean(SceneMetric):
    """Mean of a value over all frames of all scenes."""

    # One row for a frame: its value.
    truth_columns = 1

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
            self.add(SceneRecord(name, table))

    def compute(self) -> Tensor:
        """Return the mean, a float64 scalar; NaN if no frame was seen."""
        values = self.truths().flatten().tolist()
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


class NewViewScores(SceneMetric):
    """PSNR in decibels and SSIM, means over all new views; and the PSNR of two answers that render nothing.

    ``best_constant`` is the photograph's own mean colour, which no other constant beats. ``nearest_frame`` is
    the frame that was seen by the nearest camera (``nearest_frames``), as it is.

    Args:
        **kwargs: see ``torchmetrics.Metric``.
    """

    # One row for a new view: its columns.
    truth_columns = len(_COLUMNS)

    def update(self, rendered: Tensor, truth: Views, seen: Views, scene_ids: Sequence[str]) -> None:
        """Compare the new views of scenes with photographs.

        Args:
            rendered: ``(B, V, 3, H, W)`` in [0, 1].
            truth: the V photographs of each scene.
            seen: the frames that they were rendered from, of the same size.
            scene_ids: the name of each scene; all its new views are given at once.

        Raises:
            ShapeError: the shapes differ, or there are not as many names as scenes.
        """
        photographs, frames = truth.colors(), seen.colors()
        if rendered.shape != photographs.shape or len(scene_ids) != len(rendered):
            raise ShapeError(
                "expected as many rendered views (B, V, 3, H, W) as photographs, with a name for each scene, "
                f"got {tuple(rendered.shape)}, {tuple(photographs.shape)} and {len(scene_ids)} names"
            )
        nearest = nearest_frames(Cameras.of(truth), Cameras.of(seen))
        for index, name in enumerate(scene_ids):
            photograph = photographs[index].float()
            constant = photograph.mean(dim=(2, 3), keepdim=True).expand_as(photograph)
            answers = (rendered[index].float(), constant, frames[index, nearest[index]].float())
            psnr = [psnr_of_frames(answer, photograph) for answer in answers]
            table = torch.stack([psnr[0], ssim_of_frames(answers[0], photograph), *psnr[1:]], dim=1)
            table = table.detach().cpu().double()
            self.add(SceneRecord(name, table))

    def compute(self) -> dict[str, float]:
        """Return the mean of each column over all new views, NaN if there is none, and their number."""
        columns = self.truths().T.tolist()
        means = {
            name: math.fsum(values) / len(values) if values else math.nan
            for name, values in zip(_COLUMNS, columns, strict=True)
        }
        return means | {"n_views": len(columns[0])}

    def rows(self) -> list[Row]:
        """Return a row for each new view: its scene, its number there, and its columns."""
        rows: list[Row] = []
        for record in self.synchronised_scenes():
            for number, values in enumerate(record.truths.tolist()):
                rows.append(
                    {"scene_id": record.scene_id, "view": number, **dict(zip(_COLUMNS, values, strict=True))}
                )
        return rows


def nearest_frames(cameras: Cameras, seen: Cameras) -> Tensor:
    """Return which of the N cameras of a scene stands and looks most like each of V others, ``(B, V)``.

    A metre between the cameras counts like a radian between their directions of sight.
    """
    away = torch.cdist(cameras.position, seen.position)
    ahead, seen_ahead = (which.world_from_camera[..., :3, 2] for which in (cameras, seen))
    cosine = torch.einsum("bvi,bni->bvn", ahead, seen_ahead)
    return (away + cosine.clamp(-1, 1).acos()).argmin(dim=-1)
