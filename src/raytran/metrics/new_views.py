# SPDX-License-Identifier: Apache-2.0
"""How well new views are rendered, beside two ways to answer without rendering (RayTran appendix A)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from raytran.errors import ShapeError
from raytran.geometry.camera import Cameras
from raytran.metrics.image import psnr_of_frames, ssim_of_frames
from raytran.metrics.records import RecordMetric, Row, SceneRecord
from raytran.structs import Views

_COLUMNS = ("psnr", "ssim", "psnr_best_constant", "psnr_nearest_frame")


class NewViewScores(RecordMetric):
    """PSNR in decibels and SSIM, means over all new views; and the PSNR of two answers that render nothing.

    ``best_constant`` is the photograph's own mean colour, which no other constant beats. ``nearest_frame`` is
    the frame that was seen by the nearest camera (``nearest_frames``), as it is.

    Args:
        **kwargs: see ``torchmetrics.Metric``.
    """

    # One row for a new view: its columns.
    truth_columns = len(_COLUMNS)
    prediction_columns = 0

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
            self.keep(SceneRecord(name, table, table.new_zeros(0, self.prediction_columns)))

    def compute(self) -> dict[str, float]:
        """Return the mean of each column over all new views, NaN if there is none, and their number."""
        tables = [record.truths for record in self.scenes()]
        columns = torch.cat(tables).T.tolist() if tables else [[]] * len(_COLUMNS)
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
