# SPDX-License-Identifier: Apache-2.0
"""Hand-held camera paths: a walk through the free part of a room that sees every object several times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.graph import MCP_Geometric

from raytran.geometry.camera import pose_from_heading
from raytran.rooms.objects import Boxes
from raytran.rooms.render import Pinhole, Renderer
from raytran.rooms.room import Room

FIELD_OF_VIEW = np.deg2rad(58.0)
"""Horizontal field of view, as of ScanNet's sensor; with 4:3 pictures the vertical one is 45°."""

LOOK_DOWN = np.deg2rad(25.0)
"""Mean angle below the horizon of the viewing direction."""

HEIGHTS = (1.2, 1.8)
"""Range of camera heights, metres."""

MIN_VIEWS = 3
"""Frames in which each object must be seen (all frames, if a scan has fewer)."""

CLEARANCE = 0.12
"""Least distance from a camera to furniture, metres."""

_CELL = 0.1
_HEADINGS = 48
_PITCHES = 10
_SEEN_SHARE = 0.003
_MIN_SHARE = 0.0012
"""Share of a picture that an object must cover to count as seen in it."""


@dataclass(frozen=True)
class Handling:
    """How a camera is held.

    Attributes:
        field_of_view: horizontal, radians.
        heights: least and greatest height, metres.
        height: mean height, metres.
        rise: how far it goes up and down, metres.
        look_down: mean angle below the horizon, radians.
        nod: how far that angle varies along the walk, radians.
        roll: how far the camera tilts sideways along the walk, radians.
        shake: standard deviation of heading and pitch from frame to frame, radians.
        tremble: that of the roll, radians.
    """

    field_of_view: float = float(FIELD_OF_VIEW)
    heights: tuple[float, float] = HEIGHTS
    height: float = float(np.mean(HEIGHTS))
    rise: float = 0.22
    look_down: float = float(LOOK_DOWN)
    nod: float = float(np.deg2rad(4))
    roll: float = float(np.deg2rad(2.5))
    shake: float = float(np.deg2rad(1.5))
    tremble: float = float(np.deg2rad(0.7))


STEADY = Handling()
"""As ScanNet was scanned."""


def draw_handling(rng: np.random.Generator, *, portrait: bool) -> Handling:
    """Draw how a person holds a telephone: what lens, how high, how far down, how steady.

    The longer side of the picture has a field of view of 45° to 90°; in ``portrait`` that is the upright one.
    """
    field = np.deg2rad(45 + 45 * rng.beta(1.6, 2.0)) if not portrait else np.deg2rad(rng.uniform(55, 85))
    if portrait:
        field = 2 * np.arctan(0.75 * np.tan(field / 2))
    height = rng.uniform(1.15, 1.7)
    return Handling(
        field_of_view=float(field),
        heights=(0.9, 1.9),
        height=float(height),
        rise=float(rng.uniform(0.05, 0.3)),
        look_down=float(np.deg2rad(rng.uniform(6, 34))),
        nod=float(np.deg2rad(rng.uniform(2, 11))),
        roll=float(np.deg2rad(rng.uniform(0.5, 5))),
        shake=float(np.deg2rad(rng.uniform(0.5, 3.5))),
        tremble=float(np.deg2rad(rng.uniform(0.3, 1.5))),
    )


@dataclass(frozen=True)
class _Survey:
    """Which objects are seen from which positions in which directions.

    Attributes:
        position: ``(p, 2)`` points of the floor plan, metres.
        share: ``(p, headings, M)`` of the picture that each object covers.
    """

    position: NDArray[np.float64]
    share: NDArray[np.float64]


def make_intrinsics(
    image_size: tuple[int, int], rng: np.random.Generator, field_of_view: float = float(FIELD_OF_VIEW)
) -> NDArray[np.float64]:
    """Draw a camera matrix ``(3, 3)`` near that of a sensor for pictures of ``image_size`` (H, W).

    Args:
        image_size: ``(H, W)``.
        rng: source of how it differs from the sensor's.
        field_of_view: horizontal, radians; that of ScanNet's by default.
    """
    height, width = image_size
    focal = width / 2 / np.tan(field_of_view / 2) * rng.uniform(0.985, 1.015)
    center = np.array([width, height]) * (0.5 + rng.uniform(-0.006, 0.006, size=2))
    return np.array([[focal, 0.0, center[0]], [0.0, focal, center[1]], [0.0, 0.0, 1.0]]).round(6)


def plan_path(
    *,
    room: Room,
    boxes: Boxes,
    renderer: Renderer,
    intrinsics: NDArray[np.float64],
    image_size: tuple[int, int],
    frames: int,
    rng: np.random.Generator,
    handling: Handling = STEADY,
    clutter: Boxes | None = None,
) -> tuple[list[Pinhole], NDArray[np.bool_]]:
    """Walk a camera through a furnished room.

    Args:
        room: the room.
        boxes: the boxes of its ``M`` objects.
        renderer: of the furnished room; its owners are numbers of objects.
        intrinsics: ``(3, 3)``.
        image_size: ``(H, W)``.
        frames: number of cameras.
        rng: source of all choices.
        handling: how the camera is held.
        clutter: boxes of what stands about and is no object.

    Returns:
        the cameras in the order of the walk, and ``(M,)`` which objects are seen in too few of them.
    """
    free = _free_cells(room, boxes if clutter is None else Boxes.joined([boxes, clutter]))
    survey = _survey(free, boxes, renderer, rng, handling)
    weight = np.ones(len(boxes))
    best: tuple[list[Pinhole], NDArray[np.bool_]] | None = None
    for _ in range(5):
        stations = _choose_stations(survey, weight, min(max(3, frames // 2), 14), rng)
        path = _walk(free, survey, stations, frames, rng, handling)
        cameras = [Pinhole(intrinsics, pose, image_size) for pose in path]
        missed = _missed(cameras, renderer, len(boxes))
        if best is None or missed.sum() < best[1].sum():
            best = cameras, missed
        if not missed.any():
            break
        weight = np.where(missed, weight * 4, weight)
    if best is None:
        raise RuntimeError("no camera path was tried")
    return best


def _free_cells(room: Room, boxes: Boxes) -> NDArray[np.bool_]:
    """Return ``(nx, ny)``: cells of the floor plan where a camera may be; one connected part of them.

    A person does not stand in furniture, yet where a room is crowded the camera may be held over low pieces.
    """
    shape = [int(length / _CELL) for length in room.size[:2]]
    x, y = ((np.arange(n) + 0.5) * _CELL for n in shape)
    plan = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    inside = ((plan > 0.3) & (plan < np.array(room.size[:2]) - 0.3)).all(axis=1)
    for wall in room.skewed:
        inside &= (plan - wall.origin) @ wall.inward > 0.3
    best = np.zeros(shape, dtype=bool)
    for lowest, margin in ((0.3, 0.2), (0.8, 0.2), (1.0, CLEARANCE + 0.06)):
        blocked = np.zeros(len(plan), dtype=bool)
        for height in np.arange(lowest, HEIGHTS[1] + 0.2, 0.1):
            points = np.column_stack([plan, np.full(len(plan), height)])
            blocked |= boxes.grown(margin).contain(points).any(axis=1)
        labels, count = ndimage.label((inside & ~blocked).reshape(shape))
        if count:
            best = labels == 1 + np.bincount(labels.ravel())[1:].argmax()
        if best.sum() * _CELL**2 > 0.12 * room.size[0] * room.size[1]:
            break
    return best


def _survey(
    free: NDArray[np.bool_], boxes: Boxes, renderer: Renderer, rng: np.random.Generator, handling: Handling
) -> _Survey:
    """Cast a panorama of rays from a sample of free cells and count each object per viewing direction."""
    cells = np.argwhere(free)
    cells = cells[rng.permutation(len(cells))[:80]]
    position = (cells + 0.5) * _CELL
    eye = np.column_stack([position, np.full(len(cells), handling.height)])
    heading = 2 * np.pi * np.arange(_HEADINGS) / _HEADINGS
    down = handling.look_down + np.deg2rad(45.0) * ((np.arange(_PITCHES) + 0.5) / _PITCHES - 0.5)
    heading, down = (a.ravel() for a in np.meshgrid(heading, down, indexing="ij"))
    rays = np.stack([np.cos(heading) * np.cos(down), np.sin(heading) * np.cos(down), -np.sin(down)], axis=-1)
    directions = np.ascontiguousarray(np.tile(rays, (len(cells), 1)), dtype=np.float32)
    owner = renderer.owner_of(renderer.first_hit(np.repeat(eye, len(rays), axis=0), directions))
    number = np.repeat(np.arange(len(cells) * _HEADINGS), _PITCHES)
    seen = np.bincount(
        number[owner >= 0] * len(boxes) + owner[owner >= 0], minlength=len(cells) * _HEADINGS * len(boxes)
    ).reshape(len(cells), _HEADINGS, len(boxes))
    width = round(_HEADINGS * handling.field_of_view / (2 * np.pi))
    window = ndimage.uniform_filter1d(seen.astype(np.float64), width, axis=1, mode="wrap")
    return _Survey(np.asarray(position, dtype=np.float64), window / _PITCHES)


def _choose_stations(
    survey: _Survey, weight: NDArray[np.float64], count: int, rng: np.random.Generator
) -> NDArray[np.int_]:
    """Choose ``count`` views (position, heading) greedily so that each object is well seen from several.

    Returns:
        ``(count, 2)`` indices into the survey.
    """
    quality = np.minimum(survey.share / (5 * _SEEN_SHARE), 1.0)
    # A camera within a step of an earlier one adds little: prefer new positions.
    novelty = np.ones(quality.shape[:2])
    times = np.zeros(len(weight))
    chosen = []
    for _ in range(count):
        gain = (quality * (weight / (1 + times) ** 2)).sum(axis=-1) * novelty
        gain = gain * rng.uniform(0.8, 1.0, size=gain.shape)
        place, heading = np.unravel_index(int(gain.argmax()), gain.shape)
        chosen.append((place, heading))
        times += quality[place, heading]
        near = np.linalg.norm(survey.position - survey.position[place], axis=1) < 0.5
        novelty[near] *= 0.6
    return np.array(chosen)


def _walk(
    free: NDArray[np.bool_],
    survey: _Survey,
    stations: NDArray[np.int_],
    frames: int,
    rng: np.random.Generator,
    handling: Handling,
) -> list[NDArray[np.float64]]:
    """Join the stations to a walk and return the poses of ``frames`` cameras on it, ``(4, 4)`` each."""
    place = survey.position[stations[:, 0]]
    heading = 2 * np.pi * stations[:, 1] / _HEADINGS
    order = _tour(place, heading)
    place, heading = place[order], np.unwrap(heading[order])
    per_leg = np.linspace(0, len(order) - 1, frames)
    legs = [_leg(free, place[i], place[i + 1]) for i in range(len(order) - 1)]
    phase = rng.uniform(0, 2 * np.pi, size=3)
    poses = []
    for t, stop in zip(np.linspace(0, 1, frames), per_leg, strict=True):
        leg = min(int(stop), len(legs) - 1)
        share = stop - leg
        spot = _along(legs[leg], share)
        turn = heading[leg] + (heading[leg + 1] - heading[leg]) * share + rng.normal(0, handling.shake)
        height = handling.height + handling.rise * np.sin(5 * t + phase[0]) + rng.normal(0, 0.015)
        down = handling.look_down + handling.nod * np.sin(9 * t + phase[1]) + rng.normal(0, handling.shake)
        roll = handling.roll * np.sin(7 * t + phase[2]) + rng.normal(0, handling.tremble)
        eye = np.append(spot, np.clip(height, *handling.heights))
        poses.append(pose_from_heading(eye, turn, down, roll))
    return poses


def _tour(place: NDArray[np.float64], heading: NDArray[np.float64]) -> list[int]:
    """Order the stations so that each is near its predecessor in position and heading (nearest neighbour)."""
    order, rest = [0], set(range(1, len(place)))
    while rest:
        last = order[-1]

        def cost(i: int, last: int = last) -> float:
            turn = abs((heading[i] - heading[last] + np.pi) % (2 * np.pi) - np.pi)
            return float(np.linalg.norm(place[i] - place[last]) + 0.8 * turn)

        order.append(min(sorted(rest), key=cost))
        rest.remove(order[-1])
    return order


def _leg(
    free: NDArray[np.bool_], start: NDArray[np.float64], end: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the shortest way through free cells, ``(k, 2)`` metres, k ≥ 2."""
    a, b = (tuple(int(i) for i in point / _CELL) for point in (start, end))
    search = MCP_Geometric(np.where(free, 1.0, -1.0))
    search.find_costs([a], [b])
    way = (np.array(search.traceback(b), dtype=np.float64) + 0.5) * _CELL
    return np.concatenate([way, way]) if len(way) == 1 else way


def _along(way: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    position = share * (len(way) - 1)
    index = min(int(position), len(way) - 2)
    return way[index] + (way[index + 1] - way[index]) * (position - index)


def _missed(cameras: list[Pinhole], renderer: Renderer, count: int) -> NDArray[np.bool_]:
    """Return ``(count,)``: which objects cover enough of the picture in too few frames."""
    times = np.zeros(count, dtype=int)
    for camera in cameras:
        owner = renderer.owners(camera, max(1, camera.image_size[0] // 48))
        share = np.bincount(owner[owner >= 0], minlength=count) / len(owner)
        times += share >= _MIN_SHARE
    return times < min(MIN_VIEWS, len(cameras))
