# SPDX-License-Identifier: Apache-2.0
"""A scene's frames under a budget, and its prediction, in one volume or in several that overlap."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NotRequired, TypedDict, Unpack

import torch
from torch import Tensor

from raytran.capture.sharpness import blurred_frames
from raytran.data.images import MIN_VIEWS
from raytran.data.scan import OpenScan, report_dropped, scan_views
from raytran.data.views import choose_by_coverage, choose_even
from raytran.errors import ConfigError, DataError
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.geometry.volumes import Volumes, cover
from raytran.model import RayTran
from raytran.postprocess import count_object_views, merge_volumes, select_objects
from raytran.structs import ScenePrediction, Views

_log = logging.getLogger(__name__)

WAYS = ("coverage", "even")
"""How frames are chosen: for what they see together, or evenly over the walk."""

LOOKED_AT = 400
"""Most frames, spread evenly, among which coverage chooses and whose images it looks at."""

_SAME_PLACE = 1e-4
"""Metres within which a volume counts as centred on its cameras."""


class Limits(TypedDict):
    """What is kept of a prediction, and in how much memory it is made; see ``predict_volume``."""

    scene_id: str
    score_threshold: float
    duplicate_iou: float | None
    views_at_once: NotRequired[int | None]
    with_shapes: NotRequired[bool]


@dataclass(frozen=True)
class RoomViews:
    """The frames from which a scene is predicted, and the volumes in which it is.

    Attributes:
        views: all frames used, in the order of the walk, B = 1.
        frame_ids: name of each.
        volumes: T of them, one for most rooms.
        members: for each volume the positions in ``views`` of its own frames.
    """

    views: Views
    frame_ids: tuple[str, ...]
    volumes: Volumes
    members: tuple[tuple[int, ...], ...]

    def views_of(self, volume: int) -> Views:
        """Return the frames of one volume."""
        return _some_views(self.views, self.members[volume])


def check_choice(frames: str, num_views: int | None) -> None:
    """Raise unless frames can be chosen in this way.

    Raises:
        ConfigError: the way is unknown, or no frame is asked for.
    """
    if frames not in WAYS:
        raise ConfigError(f"unknown frames={frames}: choose one of {', '.join(WAYS)}")
    if num_views is not None and num_views < 1:
        raise ConfigError(f"num_views={num_views} leaves no frame: give 1 or more, or null for the preset's")


def read_room(
    scan: OpenScan,
    *,
    frames: str,
    num_views: int,
    image_size: tuple[int, int],
    resolution: tuple[int, int, int],
    extent: tuple[float, float, float],
) -> RoomViews:
    """Choose frames of a scan and read them; what is left out is logged.

    Args:
        scan: an open scan.
        frames: one of ``WAYS``.
        num_views: most frames of one volume.
        image_size: ``(H, W)`` to which the images are resized.
        resolution: ``(X, Y, Z)`` voxels of a volume.
        extent: sizes of a volume, metres.

    Raises:
        DataError: fewer than two frames can be read, though more are asked for; or the cameras' positions
            cannot be metres.
    """
    report_dropped(scan)
    poses = scan.world_from_camera
    cameras = Cameras(scan.intrinsics.expand(len(scan), 3, 3), poses, scan.image_size)
    volumes, looks_into = cover(cameras, resolution=resolution, extent=extent, name=scan.scene_id)
    choose = _by_coverage if frames == "coverage" else _evenly
    chosen = choose(scan, cameras, volumes, looks_into, num_views)
    if len(volumes) == 1:
        # On the cameras that are used, as in training.
        volumes, _ = cover(_some(cameras, chosen[0]), resolution=resolution, extent=extent)
    else:
        _log.info(
            "%s is larger than the volume of %s m: predicted in %d that overlap, from %s frames",
            scan.scene_id,
            " x ".join(f"{length:g}" for length in extent),
            len(volumes),
            ", ".join(str(len(own)) for own in chosen),
        )
    return _read_chosen(scan, volumes, chosen, looks_into, image_size, fewest=min(MIN_VIEWS, num_views))


def predict_room(model: RayTran, room: RoomViews, **limits: Unpack[Limits]) -> ScenePrediction:
    """Predict a scene in all of its volumes.

    Args:
        model: the network, on any device.
        room: what ``read_room`` returned.
        limits: see ``predict_volume``.

    Returns:
        The objects, each once, and the voxels over ``room.volumes.joint()``, on the CPU.
    """
    parts = []
    for index, center in enumerate(room.volumes.center):
        views = room.views_of(index)
        mean = views.world_from_camera[0, :, :3, 3].double().mean(dim=0)
        # Left to the network where that gives the same, so that it is the same to the last bit.
        moved = len(room.volumes) > 1 or float((center - mean).abs().max()) > _SAME_PLACE
        parts.append(predict_volume(model, views, grid_center=center.float() if moved else None, **limits))
    return parts[0] if len(parts) == 1 else merge_volumes(parts, room.volumes)


def predict_volume(
    model: RayTran,
    views: Views,
    *,
    scene_id: str,
    score_threshold: float,
    duplicate_iou: float | None,
    views_at_once: int | None = None,
    with_shapes: bool = True,
    grid_center: Tensor | None = None,
) -> ScenePrediction:
    """Run the network on the views of one volume.

    Args:
        model: the network, on any device.
        views: B = 1.
        scene_id: name to give the result.
        score_threshold: objects with a lower score are left out.
        duplicate_iou: of two objects of a class with a higher box IoU, the weaker is left out; None: neither.
        views_at_once: views that pass through the network together, None for all; fewer need less memory.
        with_shapes: decode the objects' shapes.
        grid_center: ``(3,)`` centre of the volume, metres; None: the mean camera position.

    Returns:
        The objects left, with the number of views that saw each, on the CPU.
    """
    device = next(model.parameters()).device
    raw = model.predict(
        views.to(device),
        scene_id=scene_id,
        score_threshold=score_threshold,
        views_at_once=views_at_once,
        with_shapes=with_shapes,
        grid_center=None if grid_center is None else grid_center.to(device),
    )
    found = select_objects(raw.to("cpu"), score_threshold=score_threshold, duplicate_iou=duplicate_iou)
    return replace(found, objects=count_object_views(found, grid_extent=model.grid_extent))


def _read_chosen(
    scan: OpenScan,
    volumes: Volumes,
    chosen: Sequence[tuple[int, ...]],
    looks_into: Tensor,
    image_size: tuple[int, int],
    *,
    fewest: int,
) -> RoomViews:
    """Read the frames chosen for each volume, each once; volumes are left out of which none can be read."""
    wanted = sorted({frame for own in chosen for frame in own})
    views, used = scan_views(scan, wanted, image_size=image_size)
    first = {frame: place for place, frame in reversed(list(enumerate(used)))}
    kept = sorted(first)
    if len(kept) < fewest:
        raise DataError(
            f"{scan.path} has {len(kept)} frame with an image and a pose, and {fewest} are needed: "
            "give 20 or more that show the room from all sides"
        )
    # What was read in place of a damaged image belongs where it looks.
    members = [
        tuple(n for n, frame in enumerate(kept) if frame in own or (frame not in wanted and there[frame]))
        for own, there in zip(map(set, chosen), looks_into, strict=True)
    ]
    filled = [index for index, own in enumerate(members) if own]
    return RoomViews(
        views=_some_views(views, [first[frame] for frame in kept]),
        frame_ids=tuple(scan.frame_id[frame] for frame in kept),
        volumes=Volumes(volumes.resolution, volumes.extent, volumes.center[filled]),
        members=tuple(members[index] for index in filled),
    )


def _evenly(
    scan: OpenScan, cameras: Cameras, volumes: Volumes, looks_into: Tensor, num_views: int
) -> list[tuple[int, ...]]:
    """Return frames spread evenly over those that look into each volume."""
    return [_even(there.nonzero().squeeze(1), num_views) for there in looks_into]


def _by_coverage(
    scan: OpenScan, cameras: Cameras, volumes: Volumes, looks_into: Tensor, num_views: int
) -> list[tuple[int, ...]]:
    """Return the sharp frames that together see the most of each volume."""
    looked_at = choose_even(len(scan), min(len(scan), LOOKED_AT))
    blurred = torch.from_numpy(blurred_frames(scan, looked_at.tolist()))
    chosen, near = [], set()
    for center, there in zip(volumes.center, looks_into, strict=True):
        frames = looked_at[~blurred & there[looked_at]]
        grid = VoxelGrid(volumes.resolution, volumes.extent, center)
        choice = choose_by_coverage(_some(cameras, frames.tolist()), grid, num_views)
        # A camera that stands still has near-duplicates alone: then they are what there is.
        few = len(choice.frames) < min(MIN_VIEWS, num_views)
        chosen.append(_even(there.nonzero().squeeze(1), num_views) if few else _at(frames, choice.frames))
        near |= set() if few else set(_at(frames, choice.near_duplicates))
    used = {frame for own in chosen for frame in own}
    _log.info(
        "%s: chose %d of %d frames for what they see together; left out %d near-duplicates and %d that are "
        "blurred or cannot be read",
        scan.scene_id,
        len(used),
        len(looked_at),
        len(near - used),
        int(blurred.sum()),
    )
    return chosen


def _even(frames: Tensor, count: int) -> tuple[int, ...]:
    """Return up to ``count`` of some frames, spread evenly."""
    return tuple(dict.fromkeys(frames[choose_even(len(frames), count)].tolist()))


def _at(frames: Tensor, places: Sequence[int]) -> tuple[int, ...]:
    return tuple(frames[list(places)].tolist())


def _some(cameras: Cameras, frames: Sequence[int]) -> Cameras:
    index = list(frames)
    return Cameras(cameras.intrinsics[index], cameras.world_from_camera[index], cameras.image_size)


def _some_views(views: Views, index: Sequence[int]) -> Views:
    kept = list(index)
    return Views(views.images[:, kept], views.intrinsics[:, kept], views.world_from_camera[:, kept])
