# SPDX-License-Identifier: Apache-2.0
"""The frames from which a room is predicted, as many as are allowed, and the volumes in which it is."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from raytran.capture.frames import blurred_frames
from raytran.data.images import MIN_VIEWS
from raytran.data.scan import OpenScan, report_dropped, scan_views
from raytran.data.views import choose_by_coverage, choose_even
from raytran.errors import ConfigError, DataError
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.geometry.room_tiles import Volumes, cover
from raytran.model import RayTran
from raytran.structs import Views

_log = logging.getLogger(__name__)

FRAME_CHOICES = ("coverage", "even")
"""How frames are chosen: for what they see together, or evenly over the walk."""

MAX_CANDIDATES = 400
"""Most frames, spread evenly, among which coverage chooses; their images are checked for blur."""


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

    @classmethod
    def in_one_volume(cls, views: Views, frame_ids: Sequence[str], model: RayTran) -> RoomViews:
        """Return all frames of a room with the network's volume centred on their cameras, as in training."""
        center = views.world_from_camera[0, :, :3, 3].double().mean(dim=0, keepdim=True)
        volumes = Volumes(model.grid_resolution, model.grid_extent, center)
        return cls(views, tuple(frame_ids), volumes, (tuple(range(len(frame_ids))),))

    def views_of(self, volume: int) -> Views:
        """Return the frames of one volume."""
        return self.views.select(torch.tensor(self.members[volume]))


def check_choice(frames: str, num_views: int | None) -> None:
    """Raise unless frames can be chosen like that.

    Raises:
        ConfigError: the choice is unknown, or no frame is asked for.
    """
    if frames not in FRAME_CHOICES:
        raise ConfigError(f"unknown frames={frames}: choose one of {', '.join(FRAME_CHOICES)}")
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
        frames: one of ``FRAME_CHOICES``.
        num_views: most frames of one volume.
        image_size: ``(H, W)`` to which the images are resized.
        resolution: ``(X, Y, Z)`` voxels of a volume.
        extent: sizes of a volume, metres.

    Raises:
        DataError: fewer than two frames can be read, though more are asked for; or the cameras' positions
            cannot be metres.
    """
    report_dropped(scan)
    cameras = scan.cameras
    volumes, looks_into = cover(cameras, resolution=resolution, extent=extent, name=scan.scene_id)
    choose = _choose_by_coverage if frames == "coverage" else _choose_evenly
    chosen = choose(scan, cameras, volumes, looks_into, num_views)
    if len(volumes) == 1:
        # On the cameras that are used, as in training.
        volumes, _ = cover(cameras[list(chosen[0])], resolution=resolution, extent=extent)
    else:
        _log.info(
            "%s is larger than the volume of %s m: predicted in %d that overlap, from %s frames",
            scan.scene_id,
            " x ".join(f"{length:g}" for length in extent),
            len(volumes),
            ", ".join(str(len(of_volume)) for of_volume in chosen),
        )
    return _read_chosen(scan, volumes, chosen, looks_into, image_size, fewest=min(MIN_VIEWS, num_views))


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
    wanted = sorted({frame for of_volume in chosen for frame in of_volume})
    # For a damaged image ``scan_views`` reads the nearest frame that is not: some may come twice.
    views, read = scan_views(scan, wanted, image_size=image_size)
    position = {frame: index for index, frame in reversed(list(enumerate(read)))}
    frames = sorted(position)
    if len(frames) < fewest:
        raise DataError(
            f"{scan.path} has {len(frames)} frame with an image and a pose, and {fewest} are needed: "
            "give 20 or more that show the room from all sides"
        )
    # A frame read instead of a damaged one was chosen for no volume: it belongs to those it looks into.
    members = [
        tuple(
            index
            for index, frame in enumerate(frames)
            if frame in of_volume or (frame not in wanted and looks_inside[frame])
        )
        for of_volume, looks_inside in zip(map(set, chosen), looks_into, strict=True)
    ]
    with_frames = [index for index, of_volume in enumerate(members) if of_volume]
    return RoomViews(
        views=views.select(torch.tensor([position[frame] for frame in frames])),
        frame_ids=tuple(scan.frame_id[frame] for frame in frames),
        volumes=Volumes(volumes.resolution, volumes.extent, volumes.center[with_frames]),
        members=tuple(members[index] for index in with_frames),
    )


def _choose_evenly(
    scan: OpenScan, cameras: Cameras, volumes: Volumes, looks_into: Tensor, num_views: int
) -> list[tuple[int, ...]]:
    """Return frames spread evenly over those that look into each volume."""
    return [_spread(looks_inside.nonzero().squeeze(1), num_views) for looks_inside in looks_into]


def _choose_by_coverage(
    scan: OpenScan, cameras: Cameras, volumes: Volumes, looks_into: Tensor, num_views: int
) -> list[tuple[int, ...]]:
    """Return the sharp frames that together see the most of each volume."""
    candidates = choose_even(len(scan), min(len(scan), MAX_CANDIDATES))
    blurred = torch.from_numpy(blurred_frames(scan, candidates.tolist()))
    chosen: list[tuple[int, ...]] = []
    near_duplicates: set[int] = set()
    for center, looks_inside in zip(volumes.center, looks_into, strict=True):
        sharp = candidates[~blurred & looks_inside[candidates]]
        grid = VoxelGrid(volumes.resolution, volumes.extent, center)
        choice = choose_by_coverage(cameras[sharp], grid, num_views)
        if len(choice.frames) < min(MIN_VIEWS, num_views):
            # The camera stands still: all frames are near-duplicates of each other, and must do.
            chosen.append(_spread(looks_inside.nonzero().squeeze(1), num_views))
        else:
            chosen.append(tuple(sharp[list(choice.frames)].tolist()))
            near_duplicates.update(sharp[list(choice.near_duplicates)].tolist())
    used = {frame for of_volume in chosen for frame in of_volume}
    _log.info(
        "%s: chose %d of %d frames for what they see together; left out %d near-duplicates and %d that are "
        "blurred or cannot be read",
        scan.scene_id,
        len(used),
        len(candidates),
        len(near_duplicates - used),
        int(blurred.sum()),
    )
    return chosen


def _spread(frames: Tensor, count: int) -> tuple[int, ...]:
    """Return up to ``count`` of some frames, spread evenly."""
    return tuple(dict.fromkeys(frames[choose_even(len(frames), count)].tolist()))
