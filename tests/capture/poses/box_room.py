# SPDX-License-Identifier: Apache-2.0
"""A box with patterned walls, seen by a camera that walks in a circle: quick to draw, easy to match."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image
from scipy import ndimage

from raytran.geometry.camera import pose_from_heading

SIZE = np.array([4.0, 3.6, 2.5])
"""Metres; one corner is the origin, +z is up."""

CAMERA_HEIGHT = 1.45
_TEXTURE = 384


@dataclass(frozen=True)
class BoxRoom:
    """The room and its camera.

    Attributes:
        image_size: ``(H, W)``.
        focal: pixels.
        walls: ``(6, s, s, 3)`` patterns of the six sides.
    """

    image_size: tuple[int, int]
    focal: float
    walls: np.ndarray

    @classmethod
    def make(cls, image_size: tuple[int, int] = (180, 240)) -> BoxRoom:
        rng = np.random.default_rng(0)
        noise = rng.normal(size=(6, _TEXTURE, _TEXTURE, 3))
        layers = [ndimage.gaussian_filter(noise, (0, s, s, 0)) * s for s in (1.5, 4, 10)]
        total = sum(layers)
        walls = np.clip(128 + 45 * total / total.std(), 0, 255)
        return cls(image_size, 0.85 * image_size[1], walls)

    def walk(self, count: int, turn: float = 2 * np.pi) -> np.ndarray:
        """Return ``(n, 4, 4)`` poses on a circle, looking across the room and down."""
        poses = []
        for t in np.linspace(0, turn, count, endpoint=False):
            eye = SIZE / 2 + np.array([-np.cos(t), -np.sin(t), 0]) * 0.9
            eye[2] = CAMERA_HEIGHT + 0.08 * np.sin(3 * t)
            poses.append(pose_from_heading(eye, t, np.deg2rad(25), np.deg2rad(3) * np.sin(5 * t)))
        return np.array(poses)

    def draw(self, pose: np.ndarray) -> Image.Image:
        height, width = self.image_size
        v, u = np.mgrid[:height, :width] + 0.5
        rays = np.stack([(u - width / 2) / self.focal, (v - height / 2) / self.focal, np.ones_like(u)], -1)
        rays = rays @ pose[:3, :3].T
        with np.errstate(divide="ignore"):
            hits = np.where(rays > 0, (SIZE - pose[:3, 3]) / rays, -pose[:3, 3] / rays)
        axis = hits.argmin(axis=-1)
        depth = np.take_along_axis(hits, axis[..., None], -1)
        point = pose[:3, 3] + rays * depth
        wall = 2 * axis + (np.take_along_axis(rays, axis[..., None], -1)[..., 0] > 0)
        others = np.array([[1, 2], [0, 2], [0, 1]])[axis]
        place = np.take_along_axis(point, others, -1) / 4.0 * (_TEXTURE - 2)
        rows, columns = place[..., 0], place[..., 1]
        r, c = rows.astype(int).clip(0, _TEXTURE - 2), columns.astype(int).clip(0, _TEXTURE - 2)
        a, b = (rows - r)[..., None], (columns - c)[..., None]
        walls = self.walls
        color = (walls[wall, r, c] * (1 - a) + walls[wall, r + 1, c] * a) * (1 - b)
        color += (walls[wall, r, c + 1] * (1 - a) + walls[wall, r + 1, c + 1] * a) * b
        return Image.fromarray(color.round().astype(np.uint8))


def aligned(found: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, float]:
    """Return poses brought to others by the best similarity (Umeyama 1991), and its scale."""
    a, b = found[:, :3, 3], true[:, :3, 3]
    a0, b0 = a - a.mean(axis=0), b - b.mean(axis=0)
    u, s, vt = np.linalg.svd(b0.T @ a0)
    flip = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ flip @ vt
    scale = (s * np.diag(flip)).sum() / (a0**2).sum()
    result = found.copy()
    result[:, :3, :3] = rotation @ found[:, :3, :3]
    result[:, :3, 3] = scale * a0 @ rotation.T + b.mean(axis=0)
    return result, float(scale)
