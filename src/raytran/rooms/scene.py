# SPDX-License-Identifier: Apache-2.0
"""Makes a whole scene before it is written: a furnished room, a camera walk, and their pose in the scan."""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from raytran.errors import ConfigError
from raytran.rooms import busy
from raytran.rooms.building import build_room
from raytran.rooms.cameras import draw_handling, make_intrinsics, plan_path
from raytran.rooms.film import Film, draw_film, tracked_poses
from raytran.rooms.finishes import clutter_finish, object_finish
from raytran.rooms.furnish import ROOM_KINDS, Furnisher
from raytran.rooms.layout import Layout
from raytran.rooms.library import ModelPool
from raytran.rooms.materials import ROOM_OWNER, Paint, Surfaces, texture_index, texture_library
from raytran.rooms.objects import FLOOR, Boxes, PlacedObject
from raytran.rooms.render import Pinhole, Renderer
from raytran.rooms.room import Room, make_room
from raytran.rooms.textures import photo_textures

Look = Literal["plain", "world"]
"""How rooms are: see ``make_scene``."""

_ATTEMPTS = 40


@dataclass(frozen=True)
class RoomSettings:
    """What every room of a data set has in common.

    Attributes:
        seed: with the scene's number it determines everything about the scene.
        frames: pictures with a valid pose.
        image_size: ``(H, W)`` pixels.
        min_objects: least number of objects.
        max_objects: greatest number of objects.
        room_size: ranges of the longer and of the shorter side of the floor, metres.
    """

    seed: int
    frames: int
    image_size: tuple[int, int]
    min_objects: int
    max_objects: int
    room_size: tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class Scene:
    """A furnished room with a camera walk.

    Attributes:
        room: the empty room.
        objects: its objects, parents before what stands on them.
        cameras: the walk, in the room's frame.
        renderer: draws the room.
        scan_from_room: ``(4, 4)`` pose of the room in its scan, whose axes are not those of the room.
        film: what makes pictures of light; None where the renderer's exposure does.
        tracked: ``(n, 4, 4)`` what tracking found of the cameras' poses; None where that is what they are.
        calibrated: ``(3, 3)`` what calibration found of the intrinsics; None where that is what they are.
    """

    room: Room
    objects: tuple[PlacedObject, ...]
    cameras: tuple[Pinhole, ...]
    renderer: Renderer
    scan_from_room: NDArray[np.float64]
    film: Film | None = None
    tracked: NDArray[np.float64] | None = None
    calibrated: NDArray[np.float64] | None = None


def make_scene(
    settings: RoomSettings,
    rng: np.random.Generator,
    pool: ModelPool | None = None,
    *,
    textures: int = 0,
    look: Look = "plain",
) -> Scene:
    """Draw a scene in which every object is seen in several frames.

    Args:
        settings: what all rooms have in common.
        rng: source of all choices.
        pool: where the furniture comes from; None for generated models.
        textures: which draw of the textures is used.
        look: ``"plain"``: tidy rooms without clutter, seen by a steady camera in even light; ``"world"``:
            rooms as people leave them, recorded with a telephone.

    Raises:
        ConfigError: no such scene was found, as when many objects are asked of a tiny room.
    """
    pool = pool or ModelPool(settings.seed)
    for _ in range(_ATTEMPTS):
        layout = _furnish(settings, pool, rng) if look == "plain" else _furnish_busily(settings, pool, rng)
        if len(layout.objects) < settings.min_objects:
            continue
        record = _record if look == "plain" else _film
        scene = record(settings, layout, rng, textures)
        if scene is not None:
            return scene
    (a, b), (c, d) = settings.room_size
    raise ConfigError(
        f"no room of {a}-{b} m by {c}-{d} m was found that shows the camera {settings.min_objects} to "
        f"{settings.max_objects} objects; ask for fewer objects or larger rooms"
    )


def _furnish(settings: RoomSettings, pool: ModelPool, rng: np.random.Generator) -> Layout:
    kind = str(rng.choice(list(ROOM_KINDS), p=list(ROOM_KINDS.values())))
    x, y = (rng.uniform(low, high) for low, high in settings.room_size)
    if kind == "bathroom":
        x, y = (low + 0.35 * (side - low) for side, (low, _) in zip((x, y), settings.room_size, strict=True))
    size = (x, y, rng.uniform(2.4, 3.0))
    # Few rooms are crowded: the number of objects follows the area, with a long tail.
    usual = settings.min_objects + (0.35 + rng.gamma(2.0, 0.3)) * (x * y - 4)
    wanted = int(np.clip(usual * rng.uniform(0.5, 1.0), settings.min_objects, settings.max_objects))
    layout = Layout(room=make_room(kind, size, rng), rng=rng)
    Furnisher(layout=layout, pool=pool, wanted=wanted).furnish()
    return layout


def _record(settings: RoomSettings, layout: Layout, rng: np.random.Generator, textures: int) -> Scene | None:
    """Walk a camera through the room and remove objects it sees too rarely; None if too few remain."""
    paints = [_paint_object(placed, rng) for placed in layout.objects]

    def draw(objects: Sequence[int]) -> Renderer:
        placed = [layout.objects[i] for i in objects]
        return _make_renderer(layout.room, placed, [paints[i] for i in objects], textures)

    intrinsics = make_intrinsics(settings.image_size, rng)
    walked = _walk(settings, layout, rng, draw, intrinsics=intrinsics, image_size=settings.image_size)
    if walked is None:
        return None
    objects, cameras, renderer = walked
    renderer.expose(cameras[:: max(1, len(cameras) // 6)], brightness=rng.uniform(0.35, 0.55))
    return Scene(layout.room, objects, tuple(cameras), renderer, _draw_scan_frame(layout.room, rng))


def _walk(
    settings: RoomSettings,
    layout: Layout,
    rng: np.random.Generator,
    draw: Callable[[Sequence[int]], Renderer],
    **camera: Any,
) -> tuple[tuple[PlacedObject, ...], list[Pinhole], Renderer] | None:
    """Walk a camera through a room, without the objects that it sees too rarely.

    Args:
        settings: what all rooms have in common.
        layout: the furnished room.
        rng: source of all choices.
        draw: returns a renderer of the room with the objects of these numbers.
        camera: arguments of ``plan_path``.

    Returns:
        the objects that remain, the cameras, and a renderer of the room with these objects; None if too few
        remain.
    """
    renderer = draw(range(len(layout.objects)))
    cameras, missed = plan_path(
        room=layout.room,
        boxes=Boxes.joined([placed.box for placed in layout.objects]),
        renderer=renderer,
        frames=settings.frames,
        rng=rng,
        **camera,
    )
    if not missed.any():
        return tuple(layout.objects), cameras, renderer
    remaining = _without(layout.objects, missed)
    if len(remaining) < settings.min_objects:
        return None
    return _renumbered(layout.objects, remaining), cameras, draw(remaining)


def _furnish_busily(settings: RoomSettings, pool: ModelPool, rng: np.random.Generator) -> Layout:
    """Furnish a room as people do, and strew clutter."""
    kind = str(rng.choice(list(busy.ROOM_KINDS), p=list(busy.ROOM_KINDS.values())))
    most = 0.3 if kind == "bathroom" else 1.0
    # Large rooms are rarer than small ones.
    x, y = (low + most * (high - low) * rng.beta(1.4, 2.2) for low, high in settings.room_size)
    size = (x, y, float(rng.choice([rng.uniform(2.2, 2.45), rng.uniform(2.4, 2.9), rng.uniform(2.9, 3.6)])))
    usual = settings.min_objects + (0.25 + rng.gamma(2.0, 0.28)) * (x * y - 4)
    wanted = int(np.clip(usual * rng.uniform(0.4, 1.0), settings.min_objects, settings.max_objects))
    layout = Layout(room=build_room(kind, size, rng), rng=rng, stretch=0.15)
    furnisher = busy.BusyFurnisher(layout=layout, pool=pool, wanted=wanted)
    furnisher.furnish()
    furnisher.strew(float(rng.choice([0.2, 0.7, 1.3, 2.2], p=[0.2, 0.35, 0.3, 0.15])))
    return layout


def _film(settings: RoomSettings, layout: Layout, rng: np.random.Generator, textures: int) -> Scene | None:
    """Walk through the room with a telephone; None if too few objects are seen."""
    portrait = rng.random() < 0.2
    image_size = settings.image_size[::-1] if portrait else settings.image_size
    handling = draw_handling(rng, portrait=portrait)
    paints = _alike(layout.objects, object_finish, rng)
    littered = [clutter_finish(placed, rng) for placed in layout.clutter]
    standing = Boxes.joined([placed.box for placed in layout.clutter] + [layout.room.keep_free()])

    def draw(objects: Sequence[int]) -> Renderer:
        # What lies on an object goes with it.
        kept = [i for i, placed in enumerate(layout.clutter) if placed.parent in (FLOOR, *objects)]
        return _photographic(
            layout.room,
            [layout.objects[i] for i in objects],
            [paints[i] for i in objects],
            [layout.clutter[i] for i in kept],
            [littered[i] for i in kept],
            textures,
        )

    walked = _walk(
        settings,
        layout,
        rng,
        draw,
        intrinsics=make_intrinsics(image_size, rng, handling.field_of_view),
        image_size=image_size,
        handling=handling,
        clutter=standing,
    )
    if walked is None:
        return None
    objects, cameras, renderer = walked
    poses = np.stack([camera.room_from_camera for camera in cameras])
    calibrated = cameras[0].intrinsics.copy()
    calibrated[:2] *= 1 + rng.normal(0, 0.007)
    calibrated[:2, 2] = cameras[0].intrinsics[:2, 2] + rng.normal(0, 0.004, size=2) * image_size[::-1]
    return Scene(
        room=layout.room,
        objects=objects,
        cameras=tuple(cameras),
        renderer=renderer,
        scan_from_room=_draw_scan_frame(layout.room, rng),
        film=draw_film(rng),
        tracked=tracked_poses(poses, rng),
        calibrated=calibrated.round(6),
    )


def _alike(
    objects: Sequence[PlacedObject],
    paint: Callable[[PlacedObject, np.random.Generator], list[Paint]],
    rng: np.random.Generator,
) -> list[list[Paint]]:
    """Paint objects, those of one model alike."""
    known: dict[str, list[Paint]] = {}
    paints = []
    for placed in objects:
        if placed.model.model_id not in known:
            known[placed.model.model_id] = paint(placed, rng)
        paints.append(known[placed.model.model_id])
    return paints


def _photographic(
    room: Room,
    objects: Sequence[PlacedObject],
    paints: list[list[Paint]],
    clutter: Sequence[PlacedObject],
    littered: list[list[Paint]],
    textures: int,
) -> Renderer:
    owners = [*range(len(objects)), *([ROOM_OWNER] * len(clutter))]
    surfaces = _painted([*objects, *clutter], [*paints, *littered], owners)
    return Renderer(
        surfaces=Surfaces.joined([room.surfaces, *surfaces]),
        lights=room.lights,
        textures=photo_textures(textures),
        photographic=True,
        ambient=room.ambient,
        sun=room.sun,
    )


def _renumbered(objects: list[PlacedObject], remaining: list[int]) -> tuple[PlacedObject, ...]:
    """Return the objects that remain, with the new numbers of their parents."""
    return tuple(replace(objects[i], parent=_new_number(remaining, objects[i].parent)) for i in remaining)


def _without(objects: list[PlacedObject], missed: NDArray[np.bool_]) -> list[int]:
    """Return the numbers of the objects that remain: not missed, and not standing on an object that was."""
    remaining: list[int] = []
    for number, placed in enumerate(objects):
        if not missed[number] and (placed.parent == FLOOR or placed.parent in remaining):
            remaining.append(number)
    return remaining


def _new_number(remaining: list[int], parent: int) -> int:
    """Return the number of a parent among the objects that remain."""
    return FLOOR if parent == FLOOR else remaining.index(parent)


def _draw_scan_frame(room: Room, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw the pose ``(4, 4)`` of the room in its scan: rotated by 3 to 45 degrees and shifted."""
    yaw = np.deg2rad(rng.uniform(3.0, 45.0)) * rng.choice([-1.0, 1.0])
    sin, cos = np.sin(yaw), np.cos(yaw)
    pose = np.eye(4)
    pose[:2, :2] = [[cos, -sin], [sin, cos]]
    middle = pose[:2, :2] @ (np.array(room.size[:2]) / 2)
    pose[:2, 3] = rng.uniform(1.0, 4.0, size=2) - middle
    pose[2, 3] = rng.uniform(-0.06, 0.06)
    return pose


def _make_renderer(
    room: Room, objects: Sequence[PlacedObject], paints: list[list[Paint]], textures: int
) -> Renderer:
    parts = [room.surfaces, *_painted(objects, paints, range(len(objects)))]
    return Renderer(surfaces=Surfaces.joined(parts), lights=room.lights, textures=texture_library(textures))


def _painted(
    objects: Sequence[PlacedObject], paints: list[list[Paint]], owners: Sequence[int]
) -> list[Surfaces]:
    """Return the surfaces of objects, each with a paint for each of its materials."""
    parts = []
    for owner, placed, paint in zip(owners, objects, paints, strict=True):
        triangles, group = placed.triangles(), placed.model.face_group
        parts += [Surfaces.painted(triangles[group == i], paint[i], owner=owner) for i in range(len(paint))]
    return parts


def _paint_object(placed: PlacedObject, rng: np.random.Generator) -> list[Paint]:
    """Draw a paint for each material of an object: wood is grained, upholstery woven, a screen may be on."""
    model = placed.model
    paints = []
    soft = model.category == "sofa" or model.kind in ("armchair", "bed", "pillow")
    screen_on = model.category == "display" and rng.random() < 0.4
    for group in range(int(model.face_group.max()) + 1):
        faces = model.face_group == group
        color = model.face_color[faces][0] if faces.any() else np.ones(3)
        hue, saturation, value = colorsys.rgb_to_hsv(*color)
        if screen_on and value < 0.06:
            glow = colorsys.hsv_to_rgb(rng.random(), 0.5, 0.9)
            paints.append(Paint((0.08, 0.1, 0.15), glow, texture_index("picture"), emissive=True))
        elif saturation > 0.25 and 0.02 < hue < 0.14 and not soft:
            paints.append(_varied(color, "wood", 0.4))
        elif soft or model.category == "chair":
            paints.append(_varied(color, "fabric", 0.35))
        else:
            paints.append(_varied(color, "plaster", 0.06))
    return paints


def _varied(color: NDArray[np.float64], texture: str, contrast: float) -> Paint:
    light = np.minimum(np.asarray(color) * (1 + contrast / 3), 1.0)
    red, green, blue = light
    dark_red, dark_green, dark_blue = light * (1 - contrast)
    return Paint(
        (float(dark_red), float(dark_green), float(dark_blue)),
        (float(red), float(green), float(blue)),
        texture_index(texture),
    )
