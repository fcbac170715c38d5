# SPDX-License-Identifier: Apache-2.0
"""Pictures of a furnished room by ray casting: Lambert shading, one shadow ray a pixel, clean edges.

Rays are cast by Embree; everything else is NumPy in float32. Sums are written out instead of matrix products,
so that the bits do not depend on the number of threads of BLAS.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from raytran.rooms.materials import Surfaces, TextureLibrary, texture_library
from raytran.rooms.room import Light, Sun
from raytran.rooms.textures import PhotoTextures, photo_index

Floats = NDArray[np.float32]

_AMBIENT = (0.28, 0.28, 0.28)
_SHADOW_OFFSET = 0.002
_CORNERS = np.array([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]])
_REACH = 0.8
"""Things nearer than this take ambient light away, metres."""

_SUBPIXELS = np.array([[0.375, 0.125], [0.875, 0.375], [0.125, 0.625], [0.625, 0.875]], dtype=np.float32)


@dataclass(frozen=True)
class Pinhole:
    """One camera in the room's frame.

    Attributes:
        intrinsics: ``(3, 3)`` for images of ``image_size``, pixels.
        room_from_camera: ``(4, 4)``.
        image_size: ``(H, W)``.
    """

    intrinsics: NDArray[np.float64]
    room_from_camera: NDArray[np.float64]
    image_size: tuple[int, int]

    def directions(self, u: Floats, v: Floats) -> Floats:
        """Return ray directions ``(n, 3)`` of depth 1 through the image points ``u``, ``v`` ``(n,)``."""
        rows = self.room_from_camera[:3, :3] @ np.linalg.inv(self.intrinsics)
        a, b, c = (rows[:, i].astype(np.float32) for i in range(3))
        return u[:, None] * a + v[:, None] * b + c

    def pixel_rays(self, step: int = 1) -> Floats:
        """Return the rays through the centres of ``step × step`` blocks of pixels, row-major."""
        height, width = self.image_size
        u = (np.arange(width // step, dtype=np.float32) + 0.5) * step
        v = (np.arange(height // step, dtype=np.float32) + 0.5) * step
        return self.directions(np.tile(u, len(v)), np.repeat(v, len(u)))


class Renderer:
    """Draws one room from any number of cameras.

    Args:
        surfaces: the room and its furniture.
        lights: lamps and daylight.
        textures: of the surfaces; None for the first draw.
        photographic: corners and the feet of things are darker, things that shine have the brightness that
            their paint says whatever the exposure, and surfaces are a little stained.
        ambient: ``(3,)`` light from everywhere, linear RGB.
        sun: sunlight that falls in.
    """

    def __init__(
        self,
        *,
        surfaces: Surfaces,
        lights: Sequence[Light],
        textures: TextureLibrary | PhotoTextures | None = None,
        photographic: bool = False,
        ambient: tuple[float, float, float] = _AMBIENT,
        sun: Sun | None = None,
    ) -> None:
        self._surfaces = surfaces
        self._photographic, self._ambient, self._sun = photographic, ambient, sun
        self._lights = tuple(lights)
        self._textures = textures or texture_library()
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, np.ascontiguousarray(surfaces.triangles))
        edges = surfaces.triangles[:, 1:] - surfaces.triangles[:, :1]
        normals = np.cross(edges[:, 0], edges[:, 1])
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = (normals / np.maximum(length, 1e-12)).astype(np.float32)
        self._normals: Floats = np.ascontiguousarray(normals.T)
        # Colours are given as displayed; light adds up in linear values (gamma 2).
        self._dark: Floats = np.ascontiguousarray(surfaces.dark.T**2)
        self._range: Floats = np.ascontiguousarray(surfaces.light.T**2) - self._dark
        self._axis = np.abs(normals).argmax(axis=1).astype(np.int8)
        self._patch = self._number_patches()
        # Scale, exchanged axes and shift of the textures; None if all lie as they are.
        usual = (surfaces.mapping == np.array([1.0, 0.0, 0.0, 0.0], dtype=np.float32)).all()
        self._mapping = None if usual else np.ascontiguousarray(surfaces.mapping.T)
        self.exposure = 1.0

    def owners(self, camera: Pinhole, step: int) -> NDArray[np.int32]:
        """Return who owns what each ``step × step`` block of pixels sees, ``(H/step · W/step,)``."""
        prim = self.first_hit(camera.room_from_camera[:3, 3], camera.pixel_rays(step))
        return np.where(prim < 0, -1, self._surfaces.owner[prim]).astype(np.int32)

    def first_hit(self, origin: NDArray[np.float64], directions: Floats) -> NDArray[np.int32]:
        """Return the triangle first hit by each ray from ``origin`` ``(3,)`` or ``(n, 3)``, -1 for none."""
        origins = np.broadcast_to(np.asarray(origin, dtype=np.float32), directions.shape)
        hit: NDArray[np.int32] = self._scene.run(np.ascontiguousarray(origins), directions)
        return hit

    def owner_of(self, triangle: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the owner of each triangle, and of the room for -1."""
        return np.where(triangle < 0, -1, self._surfaces.owner[triangle]).astype(np.int32)

    def expose(self, cameras: Sequence[Pinhole], brightness: float) -> None:
        """Set the exposure so that the mean linear value over coarse pictures is ``brightness``."""
        self.exposure = 1.0
        means = []
        for camera in cameras:
            rays = camera.pixel_rays(max(1, camera.image_size[0] // 24))
            color, lamp, _, _ = self._shade(camera, rays, np.arange(len(rays)) & 3)
            means.append(float((color + lamp).mean()))
        self.exposure = brightness / max(float(np.mean(means)), 1e-3)

    def render(self, camera: Pinhole, noise: Floats) -> NDArray[np.uint8]:
        """Draw a picture ``(H, W, 3)``.

        Args:
            camera: where from.
            noise: ``(H, W, 3)`` added to the display values in [0, 255].
        """
        picture = self._draw(camera, self._display)
        values = np.moveaxis(picture, 0, -1) * np.float32(255) + noise
        return np.clip(values + np.float32(0.5), 0, 255).astype(np.uint8)

    def radiance(self, camera: Pinhole, brightest: float) -> Floats:
        """Return the light ``(3, H, W)`` that a camera gets, linear, cut off at ``brightest``."""
        return self._draw(camera, lambda color: np.minimum(color, np.float32(brightest)))

    def _draw(self, camera: Pinhole, values_of: Callable[[Floats], Floats]) -> Floats:
        """Return a picture ``(3, H, W)`` of what a function makes of light ``(3, …)``; edges are averaged."""
        height, width = camera.image_size
        row, column = np.divmod(np.arange(height * width), width)
        corner = (row & 1) * 2 + (column & 1)
        spread = (row & 3) * 4 + (column & 3) if self._photographic else None
        color, lamp, patch, opened = self._shade(camera, camera.pixel_rays(), corner, spread)
        color, lamp = (channels.reshape(3, height, width) for channels in (color, lamp))
        patches = patch.reshape(height, width)
        if opened is not None:
            opened = _smooth(opened.reshape(height, width), patches)
            color *= opened
        picture = values_of(_soften(color, lamp, patches))
        r, c = np.nonzero(_edges(patches))
        u = (c[:, None] + _SUBPIXELS[:, 0]).ravel().astype(np.float32)
        v = (r[:, None] + _SUBPIXELS[:, 1]).ravel().astype(np.float32)
        color, lamp, _, _ = self._shade(camera, camera.directions(u, v), np.tile(np.arange(4), len(r)))
        if opened is not None:
            color *= np.repeat(opened[r, c], 4)
        picture[:, r, c] = values_of(color + lamp).reshape(3, -1, 4).mean(axis=2)
        return picture

    def _display(self, color: Floats) -> Floats:
        """Turn linear light into display values in [0, 1]: a soft shoulder, then gamma 2."""
        exposed = color * np.float32(self.exposure)
        return np.sqrt(exposed * (1 + 0.1 * exposed) / (1 + 0.9 * exposed))

    def _shade(
        self,
        camera: Pinhole,
        rays: Floats,
        corner: NDArray[np.int_],
        spread: NDArray[np.int_] | None = None,
    ) -> tuple[Floats, Floats, NDArray[np.int32], Floats | None]:
        """Cast and shade rays.

        Args:
            camera: where the rays start.
            rays: ``(n, 3)`` directions of depth 1.
            corner: ``(n,)`` which quarter of a lamp the shadow ray aims at.
            spread: ``(n,)`` in which of 16 directions a ray looks for things that take ambient light away;
                None casts none.

        Returns:
            colour without the light of lamps that cast shadows ``(3, n)``, what these add ``(3, n)``, the
            patch seen ``(n,)``, and with ``spread`` the share of the ambient light that arrives ``(n,)``.
        """
        eye = camera.room_from_camera[:3, 3].astype(np.float32)
        hit = self._scene.run(np.ascontiguousarray(np.broadcast_to(eye, rays.shape)), rays, output=1)
        prim = np.maximum(hit["primID"], 0)
        depth = np.where(hit["primID"] < 0, np.float32(1), hit["tfar"])
        # From here on vectors are (3, n): whole rows are read and written.
        ray = np.ascontiguousarray(rays.T)
        normal = np.take(self._normals, prim, axis=1)
        facing = _dot(normal, ray)
        normal *= -np.sign(facing)
        point = ray * depth
        point += eye[:, None]
        slant = np.maximum(np.abs(facing) / np.sqrt(_dot(ray, ray)), np.float32(0.1))
        pixel = np.float32(1 / camera.intrinsics[0, 0])
        footprint = (depth * pixel / np.sqrt(slant)).astype(np.float32)
        light = np.empty_like(point)
        for channel in range(3):
            light[channel] = self._ambient[channel] * (0.85 + 0.15 * normal[2])
        lamp = np.zeros_like(light)
        for source in self._lights:
            strength = self._strength(source, point, normal, corner)
            target = lamp if source.shadows else light
            for channel in range(3):
                target[channel] += strength * np.float32(source.color[channel])
        if self._sun is not None:
            sunny = self._sunlight(self._sun, point, normal)
            for channel in range(3):
                lamp[channel] += sunny * np.float32(self._sun.color[channel])
        emissive = np.nonzero(self._surfaces.emissive[prim])[0]
        light[:, emissive] = 1.0 if self._photographic else 1.6 / np.float32(self.exposure)
        lamp[:, emissive] = 0
        albedo = self._albedo(prim, point, footprint)
        light *= albedo
        lamp *= albedo
        opened = None
        if spread is not None:
            opened = self._openness(point, normal, spread)
            opened[emissive] = 1
        return light, lamp, self._patch[prim], opened

    def _albedo(self, prim: NDArray[np.int32], point: Floats, footprint: Floats) -> Floats:
        """Return linear colours ``(3, n)``; textures lie along the two axes most parallel to the surface."""
        axis = self._axis[prim]
        u = np.where(axis == 0, point[1], point[0])
        v = np.where(axis == 2, point[1], point[2])
        stain = None
        if self._mapping is not None:
            stain = self._stain(u, v, footprint)
            scale, turned, along, up = np.take(self._mapping, prim, axis=1)
            scale = 1 / scale
            u, v = np.where(turned > 0, v, u) * scale + along, np.where(turned > 0, u, v) * scale + up
            footprint = footprint * scale
        color = np.take(self._range, prim, axis=1)
        color *= self._textures.sample(self._surfaces.texture[prim], u, v, footprint)
        color += np.take(self._dark, prim, axis=1)
        if stain is not None:
            color *= stain
        return color

    def _stain(self, u: Floats, v: Floats, footprint: Floats) -> Floats:
        """Return a factor ``(3, n)`` near 1: nothing in a room is of one colour, nor lit evenly."""
        stained = np.full(len(u), photo_index("stain"), dtype=np.int32)
        value = self._textures.sample(stained, u, v, footprint)
        value *= np.float32(0.3)
        value += np.float32(0.85)
        return value

    def _sunlight(self, sun: Sun, point: Floats, normal: Floats) -> Floats:
        """Return how strongly ``(n,)`` sunlight through a window lights points ``(3, n)``."""
        toward = sun.toward.astype(np.float32)
        strength = np.maximum(normal[0] * toward[0] + normal[1] * toward[1] + normal[2] * toward[2], 0)
        inward, along = sun.wall.inward.astype(np.float32), sun.wall.along.astype(np.float32)
        x, y = point[0] - np.float32(sun.wall.origin[0]), point[1] - np.float32(sun.wall.origin[1])
        speed = -(toward[0] * inward[0] + toward[1] * inward[1])
        reach = (x * inward[0] + y * inward[1]) / speed
        s = x * along[0] + y * along[1] + reach * (toward[0] * along[0] + toward[1] * along[1])
        z = point[2] + reach * toward[2]
        seen = (sun.s[0] < s) & (s < sun.s[1]) & (sun.z[0] < z) & (z < sun.z[1]) & (strength > 0)
        strength[~seen] = 0
        lit = np.nonzero(seen)[0]
        start = np.take(point, lit, axis=1) + np.take(normal, lit, axis=1) * np.float32(_SHADOW_OFFSET)
        blocked = self._scene.run(
            np.ascontiguousarray(start.T),
            np.tile(toward, (len(lit), 1)),
            dists=(reach[lit] - np.float32(0.1)).clip(0),
            query="OCCLUDED",
        )
        strength[lit[blocked >= 0]] = 0
        return strength

    def _openness(self, point: Floats, normal: Floats, spread: NDArray[np.int_]) -> Floats:
        """Return what share ``(n,)`` of the ambient light arrives, by one ray each towards near things."""
        # A unit vector added to the normal is spread by the cosine.
        toward = normal + np.take(_DIRECTIONS, spread, axis=1)
        start = point + normal * np.float32(_SHADOW_OFFSET)
        blocked = self._scene.run(
            np.ascontiguousarray(start.T),
            np.ascontiguousarray(toward.T),
            dists=np.full(len(spread), _REACH, dtype=np.float32),
            query="OCCLUDED",
        )
        return np.where(blocked >= 0, np.float32(0.2), np.float32(1))

    def _strength(self, source: Light, point: Floats, normal: Floats, corner: NDArray[np.int_]) -> Floats:
        """Return how strongly ``(n,)`` one source lights points ``(3, n)``."""
        quarter = np.zeros((3, 4))
        quarter[:2] = _CORNERS.T * source.half_side
        target = (source.position[:, None] + quarter).astype(np.float32)
        away = (np.take(target, corner, axis=1) if source.shadows else target[:, :1]) - point
        square = _dot(away, away)
        near = np.maximum(square, np.float32(0.3))
        x, y, z = (-source.direction).astype(np.float32)
        emitted = np.maximum(away[0] * x + away[1] * y + away[2] * z, 0)
        strength = np.maximum(_dot(normal, away), 0) / (near * near)
        if not source.shadows:
            return strength * emitted
        # Lamps shine sideways too and reach farther than a point would: walls throw their light back.
        strength *= (0.7 * np.sqrt(square) + 1.3 * emitted) * np.sqrt(np.sqrt(near))
        lit = np.nonzero(strength > 1e-4)[0]
        toward = np.take(away, lit, axis=1)
        start = np.take(point, lit, axis=1) + np.take(normal, lit, axis=1) * np.float32(_SHADOW_OFFSET)
        blocked = self._scene.run(
            np.ascontiguousarray(start.T),
            np.ascontiguousarray(toward.T),
            dists=np.full(len(lit), 0.97, dtype=np.float32),
            query="OCCLUDED",
        )
        strength[lit[blocked >= 0]] = 0
        return strength

    def _number_patches(self) -> NDArray[np.int32]:
        """Number the sets of triangles between which no edge shows: equal owner and colour, like normals."""
        keys = np.column_stack(
            [
                self._surfaces.owner,
                np.round(self._normals.T * 2.5),
                np.round(self._surfaces.light * 255),
                self._surfaces.texture,
            ]
        ).astype(np.int64)
        # The columns' sum weighted by large odd numbers is as good as unique, and np.unique(axis=0) is slow.
        odd = np.array(
            [0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D, 0x27D4EB2F, 0x165667B1, 0xD3A2646D, 0xFD7046C5, 0xB55A4F09]
        )
        return np.unique((keys * odd).sum(axis=1), return_inverse=True)[1].astype(np.int32)


def _directions() -> Floats:
    """Return 16 unit vectors spread evenly over the sphere ``(3, 16)``, in an order that mixes them."""
    number = np.arange(16)
    z = 1 - (2 * number + 1) / 16
    angle = number * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    return (
        np.stack([ring * np.cos(angle), ring * np.sin(angle), z]).astype(np.float32)[:, number * 7 % 16]
        * 0.98
    )


_DIRECTIONS = _directions().astype(np.float32)


def _smooth(values: Floats, patches: NDArray[np.int32]) -> Floats:
    """Average ``(H, W)`` values over 4 × 4 pixels, of those that see the same patch."""
    height, width = values.shape
    padded = np.pad(values, ((2, 1), (2, 1)))
    padded_patches = np.pad(patches, ((2, 1), (2, 1)), constant_values=-1)
    total = np.zeros_like(values)
    count = np.zeros_like(values)
    for row in range(4):
        for column in range(4):
            part = slice(row, row + height), slice(column, column + width)
            same = padded_patches[part] == patches
            total += np.where(same, padded[part], np.float32(0))
            count += same
    return total / count


def _dot(a: Floats, b: Floats) -> Floats:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _edges(patches: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Return the pixels ``(H, W)`` that see another patch than a neighbour does."""
    edges = np.zeros(patches.shape, dtype=bool)
    across = patches[:, 1:] != patches[:, :-1]
    down = patches[1:] != patches[:-1]
    edges[:, 1:] |= across
    edges[:, :-1] |= across
    edges[1:] |= down
    edges[:-1] |= down
    return edges


def _soften(color: Floats, lamp: Floats, patches: NDArray[np.int32]) -> Floats:
    """Add the lamp's light averaged over 2 × 2 pixels, whose shadow rays aim at its four quarters.

    Pixels whose block reaches into another patch keep their own value: edges are drawn anew anyhow.
    """
    same = (patches[1:, 1:] == patches[:-1, 1:]) & (patches[1:, 1:] == patches[1:, :-1])
    same &= patches[1:, 1:] == patches[:-1, :-1]
    rows = lamp[:, 1:] + lamp[:, :-1]
    mean = (rows[:, :, 1:] + rows[:, :, :-1]) * np.float32(0.25)
    chosen = lamp.copy()
    np.copyto(chosen[:, 1:, 1:], mean, where=same)
    return color + chosen
