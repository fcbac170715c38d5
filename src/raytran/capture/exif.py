# SPDX-License-Identifier: Apache-2.0
"""Images that are to be shown turned: by their EXIF orientation, or by the display rotation of a video.

Programs differ. What is based on OpenCV turns an image when it reads it, and its poses and intrinsics belong
to the turned one; COLMAP takes the pixels as they are stored. For quarter turns the aspect of the intrinsics
tells which it was. For half turns and square images a scan can be read either way, and the images themselves,
or which way is up, tell more than the habits of its format.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from raytran.capture.recording import RecordedScan
from raytran.data.images import OrientationTags, image_headers, orientation_tags
from raytran.data.scan import OpenScan
from raytran.data.scannet.scan import Scan

_LOOKED_AT = 8
"""Images of a scan in ScanNet's forms in which a tag is sought; its own never have one."""

_MOST = 0.75
"""Share of the images with a tag that must speak for one reading."""

_CLEAR_SIDE = 0.5
"""Cosine between a side of the image and up from which that side counts as the upper one."""

_SHOWN = {
    **{2: "mirrored", 3: "turned by 180°", 4: "mirrored upside down", 5: "mirrored and turned by 90°"},
    **{6: "turned by 90° clockwise", 7: "mirrored and turned by 90°", 8: "turned by 90° counter-clockwise"},
}


def tags_of(scan: OpenScan) -> OrientationTags | None:
    """Return what the files of a scan's images say of how they are to be shown; None if nothing."""
    if isinstance(scan, RecordedScan):
        return scan.images.tags
    return scan.tags if isinstance(scan, Scan) else None


def with_tags_of_files(scan: OpenScan) -> OpenScan:
    """Return a scan in one of ScanNet's forms with the tags of its images; they are taken as shown.

    Few images are looked at unless one of them has a tag. Tags that would change the size are not applied:
    the intrinsics were found to fit the images as they are stored.
    """
    if not isinstance(scan, Scan) or scan.tags is not None:
        return scan
    count = len(scan)
    some = np.unique(np.linspace(0, count - 1, min(count, _LOOKED_AT)).round().astype(int)).tolist()
    headers = image_headers([scan.image_path[index] for index in some])
    if not any(header is not None and header.orientation != 1 for header in headers):
        return scan
    tags = orientation_tags(image_headers(scan.image_path), applied=False)
    return replace(scan, tags=tags.reversed([scan.image_size] * count) or tags)


def read_the_other_way(scan: OpenScan) -> OpenScan | None:
    """Return a scan with its images turned that are read as stored, and the other way round.

    Returns:
        the scan, or None if there are none of which the size leaves both open.
    """
    tags = tags_of(scan)
    if tags is None:
        return None
    sizes = (
        [lens.size for lens in scan.lens] if isinstance(scan, RecordedScan) else [scan.image_size] * len(scan)
    )
    other = tags.reversed(sizes)
    if other is None:
        return None
    if isinstance(scan, RecordedScan):
        return replace(scan, images=scan.images.with_tags(other))
    return replace(scan, tags=other) if isinstance(scan, Scan) else None


def is_shown_by_up(scan: OpenScan, up: NDArray[np.float64]) -> bool | None:
    """Tell from up whether the poses belong to the images as shown, or as stored.

    The phone felt which side of the stored image was up and wrote it into the tag. If the poses have up at
    that side they belong to the stored image, if they have it at the top, to the shown one.

    Args:
        scan: with tags, in OpenCV axes.
        up: ``(3,)`` direction of up in its world.

    Returns:
        True for shown, False for stored, None if neither fits most of the images.
    """
    tags = tags_of(scan)
    if tags is None:
        return None
    side = sides_of_up(scan.world_from_camera.double().numpy(), up)
    at_tag = np.array(replace(tags, applied=(False,) * len(scan)).sides)
    is_turned = at_tag != 0
    shown, stored = (
        ((side == wanted)[is_turned].mean() for wanted in (0, at_tag)) if is_turned.any() else (0, 0)
    )
    if max(shown, stored) < _MOST:
        return None
    return bool(shown > stored)


def sides_of_up(world_from_camera: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return at which side of each image up is, ``(n,)``: top, right, bottom or left, 0 to 3; -1 at none."""
    # How far up points to the right and to the bottom of each image.
    right, bottom = (world_from_camera[:, :3, :2].transpose(0, 2, 1) @ up).T
    reach = np.stack([-bottom, right, bottom, -right])
    return np.where(reach.max(axis=0) < _CLEAR_SIDE, -1, reach.argmax(axis=0))


def described(tags: OrientationTags) -> str:
    """Return how images are to be shown, e.g. ``12 turned by 180° of 24 images``."""
    counts = Counter(_SHOWN[tag] for tag in tags.orientation if tag != 1)
    shown = ", ".join(f"{count} {how}" for how, count in counts.most_common())
    return f"{shown} of {len(tags.orientation)} images"
