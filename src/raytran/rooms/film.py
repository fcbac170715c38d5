# SPDX-License-Identifier: Apache-2.0
"""What the camera of a telephone makes of light: exposure, white balance, blur, noise, tone, compression.

And what tracking makes of its poses: they drift and tremble by centimetres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float32]

BRIGHTEST = 12.0
"""Light that the sensor takes at most, in units of the brightness that the scan is exposed for."""

_LEVELS = 4096
_LUMA = np.array([0.3, 0.59, 0.11], dtype=np.float32)


@dataclass(frozen=True)
class Film:
    """The camera of one scan.

    Attributes:
        target: mean brightness that frames are exposed for.
        adapts: 0: one exposure for the whole scan; 1: each frame has its own.
        balance: ``(3,)`` factors of red, green and blue.
        vignette: share of the light that is lost in the corners.
        softness: standard deviation of the blur of the lens, pixels of a picture 320 wide.
        shake: typical length of the motion blur, pixels of a picture 320 wide.
        defocus: share of the frames that are out of focus.
        shot: noise that grows with the root of the light.
        read: noise in the dark.
        chroma: share of the noise that differs between colours.
        curve: ``(4096,)`` display value over the root of the light.
        saturation: factor of the colours' distance to grey.
        sharpness: how much of the difference to a blurred picture is added.
        quality: range of the JPEG quality.
    """

    target: float
    adapts: float
    balance: Floats
    vignette: float
    softness: float
    shake: float
    defocus: float
    shot: float
    read: float
    chroma: float
    curve: Floats
    saturation: float
    sharpness: float
    quality: tuple[int, int]

    def develop(
        self, light: Floats, usual: float, motion: NDArray[np.float64], rng: np.random.Generator
    ) -> NDArray[np.uint8]:
        """Turn light into a picture.

        Args:
            light: ``(3, H, W)`` linear.
            usual: mean brightness over the scan.
            motion: ``(2,)`` direction (x, y) in which the picture moves.
            rng: source of noise and blur.

        Returns:
            ``(H, W, 3)``.
        """
        height, width = light.shape[1:]
        unit = max(height, width) / 320
        mean = max(float(np.minimum(light, 3 * usual).mean()), 1e-4)
        gain = self.target / (usual ** (1 - self.adapts) * mean**self.adapts) * np.exp(rng.normal(0, 0.05))
        picture = (
            light
            * (self.balance * np.float32(gain) * rng.normal(1, 0.01, 3).astype(np.float32))[:, None, None]
        )
        picture *= _falloff(height, width, self.vignette)
        length = self.shake * rng.gamma(0.8, 1.0) * unit
        picture = moved_blur(picture, motion, length)
        sigma = self.softness * unit
        if rng.random() < self.defocus:
            sigma = float(np.hypot(sigma, rng.uniform(0.6, 2.2) * unit))
        if sigma > 0.25:
            picture = ndimage.gaussian_filter(picture, (0, sigma, sigma), truncate=2.5)
        picture = self._noisy(picture, rng)
        # Written out: the bits of a matrix product depend on the number of threads.
        grey = picture[0] * _LUMA[0] + picture[1] * _LUMA[1] + picture[2] * _LUMA[2]
        picture = grey + np.float32(self.saturation) * (picture - grey)
        root = np.sqrt(np.clip(picture, 0, BRIGHTEST))
        shown = self.curve[(root * np.float32((_LEVELS - 1) / np.sqrt(BRIGHTEST))).astype(np.int32)]
        if self.sharpness > 0.05:
            shown += np.float32(self.sharpness) * (shown - ndimage.uniform_filter(shown, (0, 3, 3)))
        return np.moveaxis(np.clip(shown * 255 + np.float32(0.5), 0, 255), 0, -1).astype(np.uint8)

    def _noisy(self, picture: Floats, rng: np.random.Generator) -> Floats:
        """Add noise: what all channels share, and what each has alone, a little coarser than pixels."""
        height, width = picture.shape[1:]
        grain = rng.standard_normal((4, height, width), dtype=np.float32)
        grain[1:] = (grain[1:] + np.roll(grain[1:], 1, axis=1) + np.roll(grain[1:], 1, axis=2)) * np.float32(
            0.7
        )
        mixed = grain[:1] * np.float32(1 - self.chroma) + grain[1:] * np.float32(self.chroma)
        return picture + mixed * np.sqrt(
            np.float32(self.shot) * np.maximum(picture, 0) + np.float32(self.read**2)
        )


def draw_film(rng: np.random.Generator) -> Film:
    """Draw a camera: from a good telephone in daylight to a cheap sensor in a dim room."""
    poor = rng.random() ** 1.5
    warm, green = rng.normal(0.03, 0.09), rng.normal(0, 0.03)
    return Film(
        target=float(rng.uniform(0.14, 0.5)),
        adapts=float(rng.uniform(0.2, 0.95)),
        balance=np.array([np.exp(warm), np.exp(green), np.exp(-warm)], dtype=np.float32),
        vignette=float(rng.uniform(0.0, 0.45)),
        softness=float(rng.uniform(0.2, 0.5 + 0.5 * poor)),
        shake=float(rng.choice([0.3, 1.0, 2.5], p=[0.4, 0.4, 0.2])),
        defocus=float(rng.choice([0.0, 0.05, 0.2], p=[0.5, 0.35, 0.15])),
        shot=float(0.0015 * rng.uniform(0.02, 1.0) * (0.2 + 2 * poor)),
        read=float(0.012 * poor * rng.random()),
        chroma=float(rng.uniform(0.2, 0.8)),
        curve=_curve(rng),
        saturation=float(rng.uniform(0.6, 1.15)),
        sharpness=float(rng.choice([0.0, rng.uniform(0.2, 1.2)], p=[0.4, 0.6])),
        quality=_quality(rng),
    )


def _quality(rng: np.random.Generator) -> tuple[int, int]:
    low = int(rng.integers(50, 92))
    return low, min(low + 6, 95)


def _curve(rng: np.random.Generator) -> Floats:
    """Draw how light becomes a display value: shoulder, gamma, contrast, and where black ends."""
    light = np.linspace(0.0, np.sqrt(BRIGHTEST), _LEVELS) ** 2
    shoulder = rng.uniform(0.15, 0.9)
    exposed = (
        light * (1 + 0.08 * light) / (1 + shoulder * light) if rng.random() < 0.75 else np.minimum(light, 1.0)
    )
    value = np.clip(exposed, 0, 1) ** (1 / rng.uniform(1.8, 2.5))
    contrast = rng.uniform(-0.1, 0.9)
    value = value + contrast * value * (1 - value) * (2 * value - 1)
    black, white = rng.uniform(-0.06, 0.05), rng.uniform(0.95, 1.03)
    return np.clip(black + (white - black) * value, 0, 1).astype(np.float32)


def _falloff(height: int, width: int, loss: float) -> Floats:
    """Return ``(H, W)``: 1 in the middle, ``1 - loss`` in the corners."""
    y, x = np.linspace(-1, 1, height) ** 2, np.linspace(-1, 1, width) ** 2
    square = (y[:, None] + x) / 2
    return (1 - loss * square).astype(np.float32)


def moved_blur(picture: Floats, motion: NDArray[np.float64], length: float) -> Floats:
    """Blur a picture ``(3, H, W)`` along a direction ``(2,)`` (x, y) over ``length`` pixels."""
    count = min(round(length), 14)
    if count < 1:
        return picture
    step = motion / max(float(np.linalg.norm(motion)), 1e-9)
    offsets = np.linspace(-length / 2, length / 2, count + 1)
    total = np.zeros_like(picture)
    reach = int(np.ceil(length / 2)) + 1
    padded = np.pad(picture, ((0, 0), (reach, reach), (reach, reach)), mode="edge")
    height, width = picture.shape[1:]
    for offset in offsets:
        x, y = (round(float(v)) + reach for v in offset * step)
        total += padded[:, y : y + height, x : x + width]
    return total / np.float32(len(offsets))


def tracked_poses(poses: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return camera poses ``(n, 4, 4)`` as tracking finds them: a slow drift and a tremble.

    Over the scans the error is 1 to 3 cm and half a degree at most; some scans have nearly none.
    """
    count = len(poses)
    scale = rng.uniform(0.15, 1.0)
    time = np.linspace(0, 1, count)[:, None]
    phase, speed = rng.uniform(0, 2 * np.pi, (2, 6)), rng.uniform(2, 9, (2, 6))
    waves = (np.sin(speed[0] * time + phase[0]) + 0.5 * np.sin(2 * speed[1] * time + phase[1])) / np.sqrt(
        1.25
    )
    jitter = rng.standard_normal((count, 6))
    error = scale * (
        waves * np.repeat([0.014, np.deg2rad(0.3)], 3) + jitter * np.repeat([0.004, np.deg2rad(0.1)], 3)
    )
    noisy = poses.copy()
    noisy[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(error[:, 3:]).as_matrix()
    noisy[:, :3, 3] += error[:, :3]
    return noisy
