# SPDX-License-Identifier: Apache-2.0
"""New views of a predicted scene: cameras from a list, pictures beside the prediction."""

from __future__ import annotations

import logging
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from raytran.capture.render_cameras import RenderCameras, read_render_cameras
from raytran.data.files import finished_folder
from raytran.errors import ConfigError
from raytran.geometry.camera import Cameras
from raytran.geometry.room_tiles import places_ahead
from raytran.model import RayTran
from raytran.run.predict.room import RoomViews

NEW_VIEWS = "new_views"
"""The folder of the pictures, in that of the prediction."""

_log = logging.getLogger(__name__)


def cameras_to_render(path: str | None, model: RayTran, checkpoint: str) -> RenderCameras | None:
    """Return the cameras that a list names, None without a list.

    Args:
        path: the list, see ``read_render_cameras``; or None.
        model: the network that is to render them.
        checkpoint: where it comes from, for messages.

    Raises:
        ConfigError: the network cannot render.
        DataError: see ``read_render_cameras``.
    """
    if path is None:
        return None
    if "view" not in model.heads:
        raise ConfigError(
            f"{checkpoint} cannot render views={path}: give a checkpoint that was trained with "
            "experiment=novel_view, or leave views= out"
        )
    return read_render_cameras(Path(path))


def render_views(
    model: RayTran,
    room: RoomViews,
    wanted: RenderCameras,
    output: Path,
    *,
    views_at_once: int | None = None,
) -> Path:
    """Render new views and write ``<name>.png`` for each, of the size that its camera has.

    The network renders at the size of its frames; pictures are resized from that. In a room of several
    volumes each camera sees the volume that holds what is ahead of it.

    Args:
        model: with a view head, on any device.
        room: the frames to render from and the volumes.
        wanted: the new cameras, in the world of the frames.
        output: folder of the prediction, newly written, in which ``new_views`` is made.
        views_at_once: views that pass through the network together, None for all.

    Returns:
        The folder of the pictures, which appears whole or not at all.
    """
    cameras = wanted.scaled_to(room.views.image_size)
    device = next(model.parameters()).device
    owner = room.volumes.owner(places_ahead(cameras))
    with finished_folder(output / NEW_VIEWS) as folder:
        for volume, center in enumerate(room.volumes.center):
            indices = (owner == volume).nonzero().squeeze(1).tolist()  # of the cameras that see this volume
            if not indices:
                continue
            images = model.render(
                room.views_of(volume).to(device),
                cameras[indices][None].to(device),
                views_at_once=views_at_once,
                grid_center=center.float().to(device),
            )
            rendered = (image for chunk in images for image in chunk.cpu())
            for index, image in zip(indices, rendered, strict=True):
                _picture(image, wanted.lenses[index].size).save(folder / f"{wanted.names[index]}.png")
    _warn_of_cameras_outside(cameras, room)
    _log.info("rendered %d new views: %s", len(wanted), (output / NEW_VIEWS).resolve())
    return output / NEW_VIEWS


def _picture(image: Tensor, size: tuple[int, int]) -> Image.Image:
    """Return a picture ``(H, W)`` of colours ``(3, h, w)`` in [0, 1]."""
    pixels = (image * 255).round().to(torch.uint8).permute(1, 2, 0).numpy()
    return Image.fromarray(pixels).resize(size[::-1], Image.Resampling.BICUBIC)


def _warn_of_cameras_outside(cameras: Cameras, room: RoomViews) -> None:
    """Say how many cameras stand outside of all volumes: what they see was hardly trained."""
    outside = int((~room.volumes.holds(cameras.position).any(dim=1)).sum())
    if outside:
        _log.warning(
            "%d of %d new cameras stand outside of the volume: are their poses in metres and in the world of "
            "scene.json?",
            outside,
            len(cameras.position),
        )
