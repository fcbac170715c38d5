# SPDX-License-Identifier: Apache-2.0
"""Whether annotation and cameras share one world: do rays end in the boxes, or pass through them?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from raytran.capture.doctor.finding import Finding
from raytran.capture.doctor.sightings import Sightings
from raytran.structs import ObjectSet

_SLACK = 0.05
"""Metres by which a ray may end before or behind a box and still count as ending in it."""

_FEWEST_RAYS = 25
"""Rays ending in boxes below which the best reading is not believed."""

_POOR, _CLEARLY_BETTER, _MORE_INSIDE = 0.15, 0.12, 1.3
_IDLE = 0.05
"""Weight of rays that meet no box: a reading that moves all boxes out of sight must not win."""


ASTRAY = "annotation not where the images show objects"
"""Cause where no reading puts the boxes right."""


@dataclass(frozen=True)
class Reading:
    """A way to read the files: which world the annotation is in.

    Attributes:
        right_from_given: ``(4, 4)`` what must be applied to the cameras so that they share the boxes' world.
        cause: short name of the fault.
        fix: one sentence.
    """

    right_from_given: NDArray
    cause: str
    fix: str


@dataclass(frozen=True)
class Evidence:
    """How a reading fares.

    Attributes:
        score: share of the rays meeting a box that end in it, weighed down where few meet any.
        inside: rays that end in a box.
        through: rays that pass through a box.
    """

    score: float
    inside: int
    through: int


def alignment_readings(axis_alignment: NDArray[np.float64]) -> list[Reading]:
    """Return what may have happened to one side only with ``axisAlignment``, aligned_from_scan."""
    if np.allclose(axis_alignment, np.eye(4), atol=1e-4):
        return []
    back = np.linalg.inv(axis_alignment)
    once = "applied to one side only"
    return [
        Reading(
            back,
            f"axisAlignment {once} (the cameras)",
            "apply it to neither: multiply each camera-to-world matrix from the left by its inverse",
        ),
        Reading(
            axis_alignment,
            f"axisAlignment {once} (the annotation)",
            "apply it to neither: multiply the annotation's scan transforms from the right by the inverse of "
            "what they were given",
        ),
        Reading(
            back @ back,
            "axisAlignment applied twice (to the cameras)",
            "multiply each camera-to-world matrix twice from the left by the inverse of axisAlignment",
        ),
        Reading(
            axis_alignment @ axis_alignment,
            "axisAlignment applied twice (to the annotation, or its inverse to the cameras)",
            "use poses and annotation as they were released, without axisAlignment",
        ),
    ]


def turn_readings() -> list[Reading]:
    """Return quarter turns about z and other ups: worlds that other programs write."""
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=np.float64)
    named = [
        ("turned by 90° about +z", quarter),
        ("turned by 180° about +z", quarter @ quarter),
        ("turned by -90° about +z", quarter.T),
    ]
    return [
        Reading(
            _four(turn),
            f"cameras and annotation are {name} to each other",
            f"multiply each camera-to-world matrix from the left by {turn.astype(int).tolist()}",
        )
        for name, turn in named
    ]


def weigh(
    sightings: Sightings,
    world_from_camera: NDArray[np.float64],
    objects: ObjectSet,
    moved: NDArray[np.float64],
) -> Evidence:
    """Count how rays and boxes meet.

    Args:
        sightings: rays with known ends.
        world_from_camera: ``(frames, 4, 4)``.
        objects: M boxes.
        moved: ``(4, 4)`` applied to the cameras first.
    """
    origin, way = sightings.in_world(moved @ world_from_camera)
    inside = through = 0
    idle = np.ones(len(sightings), dtype=bool)
    parts = (objects.center, objects.size, objects.rotation)
    for center, size, rotation in zip(*(part.double().numpy() for part in parts), strict=True):
        start, slope = (origin - center) @ rotation, way @ rotation
        slope = np.where(np.abs(slope) < 1e-9, 1e-9, slope)
        one, two = (-size / 2 - start) / slope, (size / 2 - start) / slope
        enters, leaves = np.minimum(one, two).max(axis=1), np.maximum(one, two).min(axis=1)
        meets = (enters < leaves) & (leaves > 0)
        ends = meets & (sightings.depth > enters - _SLACK) & (sightings.depth < leaves + _SLACK)
        passes = meets & (sightings.depth >= leaves + _SLACK)
        inside, through = inside + int(ends.sum()), through + int(passes.sum())
        idle &= ~(ends | passes)
    whole = inside + through + _IDLE * int(idle.sum())
    return Evidence(inside / max(whole, 1e-9), inside, through)


def check_placement(
    sightings: Sightings,
    world_from_camera: NDArray[np.float64],
    objects: ObjectSet,
    axis_alignment: NDArray[np.float64],
) -> tuple[NDArray[np.float64], Finding]:
    """Say whether the boxes are where the images show something.

    Returns:
        ``(4, 4)`` what to apply to the cameras, and the finding.
    """
    check = "annotation placed"
    given = weigh(sightings, world_from_camera, objects, np.eye(4))
    readings = alignment_readings(axis_alignment) + turn_readings()
    weighed = [weigh(sightings, world_from_camera, objects, reading.right_from_given) for reading in readings]
    # A reading that moves boxes to where little is seen may look purer; it must catch more rays, too.
    rivals = [i for i, after in enumerate(weighed) if after.inside > _MORE_INSIDE * given.inside]
    best = max(rivals, key=lambda i: weighed[i].score, default=None)
    seen = f"{given.inside} rays end in the boxes and {given.through} pass through ({sightings.source})"
    if (
        best is not None
        and weighed[best].score > given.score + _CLEARLY_BETTER
        and weighed[best].inside >= _FEWEST_RAYS
    ):
        reading, after = readings[best], weighed[best]
        text = f"{seen}; after the change {after.inside} and {after.through}"
        sure = "certain" if after.score > 3 * given.score and after.inside > 4 * _FEWEST_RAYS else "likely"
        return reading.right_from_given, Finding(check, "fault", text, reading.cause, reading.fix, sure)
    meet = given.inside + given.through
    if meet < _FEWEST_RAYS and len(sightings) < 40 * _FEWEST_RAYS:
        return np.eye(4), Finding(check, "unknown", f"{seen}: too few to tell")
    if meet < _FEWEST_RAYS or given.inside < _POOR * meet:
        return np.eye(4), Finding(
            check,
            "fault",
            seen,
            ASTRAY,
            "check that annotation and poses are of the same scan and world",
            "likely",
        )
    return np.eye(4), Finding(check, "ok", seen)


def _four(turn: NDArray[np.float64]) -> NDArray[np.float64]:
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    return matrix
