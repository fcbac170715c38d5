# SPDX-License-Identifier: Apache-2.0
"""Places furniture in a room so that nothing interpenetrates: at walls, at tables, on top of others."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from raytran.rooms.cad import CLUTTER, CadModel
from raytran.rooms.objects import Boxes, PlacedObject, cad_box, overlaps, upright_rotation, yaw_facing
from raytran.rooms.room import Room

MAX_TILT = np.deg2rad(4.0)
"""Largest angle between an object's up axis and the room's, as in Scan2CAD's annotations."""

GAP = 0.02
"""Least distance between two objects on the floor, metres."""

_CONTACT = 0.002
_TOP_HEIGHT = 1.3


class Layout:
    """A room being furnished.

    Attributes:
        room: the room.
        rng: source of all choices.
        objects: what has been placed, in order; parents before what stands on them.
        clutter: models of the category ``CLUTTER`` that have been placed; their parents are objects.
    """

    def __init__(self, *, room: Room, rng: np.random.Generator, stretch: float = 0.05) -> None:
        """Begin with an empty room.

        Args:
            room: the room.
            rng: source of all choices.
            stretch: largest share by which models are made longer or shorter along each axis.
        """
        self.room = room
        self.rng = rng
        self.objects: list[PlacedObject] = []
        self.clutter: list[PlacedObject] = []
        self._stretch = stretch
        self._heights: dict[int, HeightAt] = {}
        self._obstacles = room.keep_free()

    def on_floor(
        self,
        model: CadModel,
        xy: NDArray[np.float64],
        yaw: float,
        *,
        tilt: bool = True,
        under: int | None = None,
    ) -> int | None:
        """Stand a model on the floor with its box centred at ``xy``.

        Args:
            model: what to place.
            xy: ``(2,)`` metres.
            yaw: radians.
            tilt: lean it a little, as annotations do.
            under: number of an object whose box it may reach into, as a chair does under a table.

        Returns:
            the object's number, or None if it does not fit there.
        """
        tilting = _draw_tilt(self.rng) if tilt else np.eye(3)
        rotation = tilting @ upright_rotation(yaw)
        scale = self._draw_scale(model)
        center, half = cad_box(model)
        drop = np.abs(rotation[2]) @ (scale * half)
        middle = np.array([xy[0], xy[1], drop + 0.001])
        translation = middle - rotation @ (scale * center)
        return self._add(PlacedObject(model, scale, rotation, translation, tilting), under)

    def at_wall(self, model: CadModel, *, near: float | None = None, wall: int | None = None) -> int | None:
        """Stand a model with its back to a wall, at wall coordinate ``near`` or anywhere along it."""
        depth, width = self.size_of(model)[[2, 0]]
        for _ in range(12):
            index = int(self.rng.integers(4)) if wall is None else wall
            side = self.room.walls[index]
            if side.length < width + 0.1:
                continue
            s = self.rng.uniform(width / 2 + 0.05, side.length - width / 2 - 0.05) if near is None else near
            for clearance in (0.03, 0.08, 0.14):
                point = side.point(s, depth * 0.53 + clearance)
                placed = self.on_floor(model, point[:2], yaw_facing(side.inward) + self.rng.normal(0, 0.01))
                if placed is not None:
                    return placed
            if near is not None:
                return None
        return None

    def anywhere(self, model: CadModel) -> int | None:
        """Stand a model somewhere on the floor, turned at random."""
        for _ in range(25):
            xy = self.rng.uniform(0.2, np.array(self.room.size[:2]) - 0.2)
            placed = self.on_floor(model, xy, self.rng.uniform(-np.pi, np.pi))
            if placed is not None:
                return placed
        return None

    def beside(
        self,
        anchor: int,
        model: CadModel,
        direction: NDArray[np.float64],
        *,
        along: float,
        facing: str,
        tucked: float = 0.0,
    ) -> int | None:
        """Stand a model next to an object on the floor.

        Args:
            anchor: number of the object.
            model: what to place.
            direction: ``(2,)`` unit vector from the anchor to where the model shall stand.
            along: shift to the left of ``direction``, metres.
            facing: ``"anchor"``: the front looks at the anchor; ``"same"``: where the anchor's front looks.
            tucked: how far the model is pushed under the anchor, metres.
        """
        other = self.objects[anchor]
        half = np.abs(direction @ (other.rotation[:2] * other.box.half[0])[:, [0, 2]]).sum()
        width, depth = self.size_of(model)[[0, 2]] / 2
        sideways = np.array([-direction[1], direction[0]])
        for gap in (0.05, 0.1, 0.18, 0.3):
            front = -direction if facing == "anchor" else -other.rotation[:2, 2]
            yaw = yaw_facing(front) + self.rng.normal(0, 0.12 if facing == "anchor" else 0.02)
            reach = half + gap + (depth if facing == "anchor" else width)
            if tucked > 0:
                reach -= tucked
            spot = other.box.center[0, :2] + direction * reach + sideways * along
            placed = self.on_floor(model, spot, yaw, under=anchor if tucked > 0 else None)
            if placed is not None:
                return placed
        return None

    def on_top(
        self, parent: int, model: CadModel, *, place: tuple[float, float] | None = None, turn: float = 0.0
    ) -> int | None:
        """Stand a model on another object, flush with its (tilted) top.

        Args:
            parent: number of the object below.
            model: what to place.
            place: position in units of the parent's half width (to its right) and half depth (to its back);
                None tries random positions.
            turn: yaw relative to the parent's, radians.
        """
        base = self.objects[parent]
        height_at = self._heights.get(parent)
        if height_at is None:
            height_at = self._heights[parent] = _height_of(base)
        half = base.box.half[0]
        for _ in range(1 if place else 8):
            share = np.array(place if place else self.rng.uniform(-0.8, 0.8, size=2))
            scale = self._draw_scale(model)
            center, extent = cad_box(model)
            spin = upright_rotation(turn) @ upright_rotation(0.0).T
            footprint = np.abs(spin[:2, :2]) @ (scale * extent)[[0, 2]]
            # In the parent's frame turned upright (x right, y back to front reversed, z up): object z is -y.
            xy = share * np.maximum(half[[0, 2]] - footprint - 0.01, 0.0) * np.array([1.0, -1.0])
            height = height_at(
                xy + base.cad_box[0][[0, 2]] * base.scale[[0, 2]] * np.array([1.0, -1.0]), footprint
            )
            if height is None:
                continue
            parent_turn = base.rotation @ upright_rotation(0.0).T
            rotation = parent_turn @ upright_rotation(turn)
            offset = base.cad_box[0][[0, 2]] * base.scale[[0, 2]] * np.array([1.0, -1.0])
            foot = np.append(xy + offset, height + _CONTACT + (scale * extent)[1])
            middle = base.translation + parent_turn @ foot
            translation = middle - rotation @ (scale * center)
            placed = self._add(PlacedObject(model, scale, rotation, translation, base.tilt, parent))
            if placed is not None:
                return placed
        return None

    @staticmethod
    def size_of(model: CadModel) -> NDArray[np.float64]:
        """Return the model's real size ``(3,)`` along its axes, metres."""
        return np.asarray(model.size_m, dtype=np.float64)

    def _draw_scale(self, model: CadModel) -> NDArray[np.float64]:
        """Draw a scale ``(3,)``: the model's real size, stretched a little as far as its symmetry allows."""
        stretch = self.rng.uniform(1 - self._stretch, 1 + self._stretch, size=3)
        if model.symmetry in (0, 4):
            stretch[2] = stretch[0]
        return np.linalg.norm(model.size_m) * stretch

    def in_shelf(self, parent: int, model: CadModel) -> int | None:
        """Stand a thing on one of the boards of an object, however many are above; None if none has room."""
        base = self.objects[parent]
        boards = _boards_of(base)
        half, size = base.box.half[0], self.size_of(model)
        for _ in range(4):
            share = self.rng.uniform(-0.9, 0.9)
            x = share * max(half[0] - size[0] / 2 - 0.03, 0.0)
            found = boards(x, size)
            if found is None:
                continue
            turn = base.rotation @ upright_rotation(0.0).T
            rotation = turn @ upright_rotation(float(self.rng.normal(0, 0.03)))
            center, _ = cad_box(model)
            scale = np.full(3, np.linalg.norm(model.size_m))
            middle = base.box.center[0] + turn @ np.array([x, found[1], found[0] + size[1] / 2 + _CONTACT])
            translation = middle - rotation @ (scale * center)
            placed = self._add(PlacedObject(model, scale, rotation, translation, base.tilt, parent))
            if placed is not None:
                return placed
        return None

    def _add(self, candidate: PlacedObject, under: int | None = None) -> int | None:
        """Add an object if it is inside the room and overlaps nothing; return its number, else None."""
        box = candidate.box
        corners = box.corners()[0]
        if not self.room.holds(corners):
            return None
        if overlaps(box, self._obstacles).any():
            return None
        others = [other.box for i, other in enumerate(self.objects) if i not in (candidate.parent, under)]
        others += [other.box for other in self.clutter]
        if others and overlaps(box.grown(GAP), Boxes.joined(others)).any():
            return None
        chosen = self.clutter if candidate.model.category == CLUTTER else self.objects
        chosen.append(candidate)
        return len(chosen) - 1


def _draw_tilt(rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw a small rotation about a horizontal axis (Rodrigues' formula)."""
    angle, heading = MAX_TILT * rng.beta(1.3, 2.2), rng.uniform(0, 2 * np.pi)
    x, y = np.cos(heading), np.sin(heading)
    cross = np.array([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _boards_of(
    base: PlacedObject,
) -> Callable[[float, NDArray[np.float64]], tuple[float, float] | None]:
    """Return a function that finds a board in a shelf.

    It takes the place along the shelf and the size ``(3,)`` of a thing, and returns the height of a board and
    the place towards the back, both from the middle of the shelf's box turned upright; None if there is none.
    """
    center, half = base.cad_box
    upright = ((base.model.vertices - center) * base.scale)[:, [0, 2, 1]] * np.array([1.0, -1.0, 1.0])
    scene = EmbreeScene()
    TriangleMesh(scene, np.ascontiguousarray(upright[base.model.faces], dtype=np.float32))
    tall, deep = half[1] * base.scale[1], half[2] * base.scale[2]

    def find(x: float, size: NDArray[np.float64]) -> tuple[float, float] | None:
        # The front of the shelf is at +y here: things stand a little behind it.
        y = deep - size[2] / 2 - 0.03
        if y < -deep + size[2] / 2:
            y = 0.0
        plan = np.array([[x - size[0] / 2, y], [x, y], [x + size[0] / 2, y]])
        heights = np.linspace(-tall + 0.02, tall, 24)
        origin = np.concatenate([np.column_stack([plan, np.full(3, z)]) for z in heights]).astype(np.float32)
        down, up = (np.tile(np.array([0, 0, sign], dtype=np.float32), (len(origin), 1)) for sign in (-1, 1))
        below = scene.run(origin, down, output=1)
        above = scene.run(origin, up, output=1)
        floor = origin[:, 2] - np.where(below["primID"] < 0, np.float32(1e3), below["tfar"])
        roof = origin[:, 2] + np.where(above["primID"] < 0, np.float32(1e3), above["tfar"])
        floor, roof = floor.reshape(-1, 3), roof.reshape(-1, 3)
        # Rays that meet nothing begin so far from the shelf that no board is found there.
        fits = (np.ptp(floor, axis=1) < 0.01) & (roof.min(axis=1) - floor.max(axis=1) > size[1] + 0.01)
        fits &= floor.min(axis=1) > -tall - 0.01
        levels = np.unique(floor[fits].max(axis=1).round(3))
        if not len(levels):
            return None
        return float(levels[int(abs(x) * 1e4) % len(levels)]), float(y)

    return find


HeightAt = Callable[[NDArray[np.float64], NDArray[np.float64]], float | None]


def _height_of(base: PlacedObject) -> HeightAt:
    """Return a function that finds where something with a given footprint can stand on ``base``.

    It takes the middle ``(2,)`` and the half extents ``(2,)`` of the footprint in the base's frame turned
    upright (origin at the CAD origin, metres) and returns the height of the surface, or None where the
    surface is not flat, too high to be reached, or absent.
    """
    upright = (base.model.vertices * base.scale)[:, [0, 2, 1]] * np.array([1.0, -1.0, 1.0])
    scene = EmbreeScene()
    TriangleMesh(scene, np.ascontiguousarray(upright[base.model.faces], dtype=np.float32))
    top = float(upright[:, 2].max()) + 0.1
    bottom = float(upright[:, 2].min())
    tolerance = 0.05 if base.model.kind in ("bed", "sofa") or base.model.category == "sofa" else 0.01

    def height_at(middle: NDArray[np.float64], half: NDArray[np.float64]) -> float | None:
        steps = np.linspace(-1.0, 1.0, 9)
        grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) * half + middle
        origins = np.column_stack([grid, np.full(len(grid), top)]).astype(np.float32)
        down = np.tile(np.array([0.0, 0.0, -1.0], dtype=np.float32), (len(grid), 1))
        hit = scene.run(origins, down, output=1)
        if (hit["primID"] < 0).any():
            return None
        heights = top - hit["tfar"]
        low, high = float(heights.min()), float(heights.max())
        return high if high - low < tolerance and 0.2 < high - bottom < _TOP_HEIGHT else None

    return height_at
