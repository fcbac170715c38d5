# SPDX-License-Identifier: Apache-2.0
"""Random changes of training scenes that keep cameras, images, objects and masks consistent.

A scene is changed as a whole: its world is rotated or mirrored, its voxel volume shifted, its colours
changed. A changed scene has no occupancy: that must be made anew from the changed objects and grid.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from raytran.data.views import choose_random
from raytran.errors import ConfigError
from raytran.structs import ObjectSet, SceneBatch, Views

_MIRROR = torch.diag(torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64))
"""x → -x, of the world, of a camera and of an object alike."""

_LUMA = torch.tensor([0.299, 0.587, 0.114])
"""Share of red, green and blue in the grey value of a pixel (ITU-R BT.601)."""

_MID_GREY = 127.5


@dataclass(frozen=True)
class Augmentation:
    """How strongly training scenes are changed; all zero leaves them as they are.

    Attributes:
        yaw_deg: the world rotates about its up axis by up to this angle, either way; 180 for any direction.
        shift: the voxel volume moves by up to this along x, y, z, either way, metres.
        mirror: probability that the scene is mirrored.
        brightness: colours are multiplied by 1 - b … 1 + b.
        contrast: distances from mid-grey are multiplied by 1 - c … 1 + c.
        saturation: distances from each pixel's own grey are multiplied by 1 - s … 1 + s.
        hue_deg: colours rotate about the grey axis of the RGB cube by up to this angle, either way.
        frame_dropout: probability that a chosen frame is left out; others are repeated in its place, so that
            the number of images stays the same.

    Raises:
        ConfigError: a value is out of range.
    """

    yaw_deg: float = 0.0
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mirror: float = 0.0
    brightness: float = 0.0
    contrast: float = 0.0
    saturation: float = 0.0
    hue_deg: float = 0.0
    frame_dropout: float = 0.0

    def __post_init__(self) -> None:
        for name in ("yaw_deg", "mirror", "brightness", "contrast", "saturation", "hue_deg", "frame_dropout"):
            value, largest = getattr(self, name), 180 if name.endswith("_deg") else 1
            if not 0 <= value <= largest:
                raise ConfigError(f"data.augmentation.{name}={value}: choose from 0 to {largest}")
        shift = tuple(self.shift) if isinstance(self.shift, Sequence) else ()
        if len(shift) != 3 or not all(0 <= length < math.inf for length in shift):
            raise ConfigError(
                f"data.augmentation.shift={self.shift}: give three lengths in metres, none of them negative"
            )
        object.__setattr__(self, "shift", shift)

    def drop_frames(self, chosen: Sequence[int], min_views: int, generator: torch.Generator) -> list[int]:
        """Leave out some of the chosen frames and repeat others in their place.

        Args:
            chosen: positions of N frames.
            min_views: fewest frames that stay.
            generator: source of the randomness.

        Returns:
            N positions, in the order of ``chosen``.
        """
        draw = torch.rand(len(chosen), generator=generator)
        stays = draw >= self.frame_dropout
        stays[draw.argsort(descending=True)[:min_views]] = True
        if stays.all():
            return list(chosen)
        remaining = [chosen[i] for i in stays.nonzero().flatten().tolist()]
        return [remaining[i] for i in choose_random(len(remaining), len(chosen), generator).tolist()]

    def __call__(self, scene: SceneBatch, generator: torch.Generator) -> SceneBatch:
        """Return the scene changed at random.

        The random numbers of one setting do not depend on the other settings.

        Args:
            scene: of any B; all of its scenes are changed alike. Images are uint8.
            generator: source of the randomness.
        """
        # All numbers are drawn always, so that switching one setting off leaves the others as they were.
        flip, yaw, *rest = torch.rand(9, generator=generator, dtype=torch.float64).tolist()
        shift = rest[:3]
        brightness, contrast, saturation, hue = (2 * number - 1 for number in rest[3:])
        if flip < self.mirror:
            scene = mirror_scene(scene)
        if self.yaw_deg:
            scene = rotate_scene(scene, math.radians(self.yaw_deg) * (2 * yaw - 1))
        if any(self.shift):
            offset = [size * (2 * number - 1) for size, number in zip(self.shift, shift, strict=True)]
            scene = replace(
                scene, grid_center=scene.grid_center + scene.grid_center.new_tensor(offset), occupancy=None
            )
        if self.brightness or self.contrast or self.saturation or self.hue_deg:
            matrix, offset_rgb = color_change(
                brightness=1 + self.brightness * brightness,
                contrast=1 + self.contrast * contrast,
                saturation=1 + self.saturation * saturation,
                hue=math.radians(self.hue_deg) * hue,
            )
            images = change_colors(scene.views.images, matrix, offset_rgb)
            scene = replace(scene, views=replace(scene.views, images=images))
        return scene


def rotate_scene(scene: SceneBatch, angle: float) -> SceneBatch:
    """Rotate the world about its up axis, counter-clockwise seen from above; images stay as they are.

    Args:
        scene: of any B.
        angle: radians.
    """
    cos, sin = math.cos(angle), math.sin(angle)
    rotation = torch.tensor([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    pose = scene.views.world_from_camera
    return _changed(
        scene,
        views=replace(scene.views, world_from_camera=_product(_in_identity(rotation, 4), pose)),
        grid_center=_product(rotation, scene.grid_center[..., None])[..., 0],
        change=lambda objects: replace(
            objects,
            center=_product(rotation, objects.center[..., None])[..., 0],
            rotation=_product(rotation, objects.rotation),
        ),
        foreground=scene.foreground,
    )


def mirror_scene(scene: SceneBatch) -> SceneBatch:
    """Mirror the world at its plane x = 0, and with it every image, camera, box and shape.

    With M = diag(-1, 1, 1) a camera's pose becomes M · pose · M and an object's rotation M · R · M, which are
    rotations again: cameras and objects are mirrored along their own x axis, images from left to right, so
    c_x → W - c_x. An object's size and symmetry stay. It is no longer its CAD model, so it has no model name.

    Args:
        scene: of any B.
    """
    views, width = scene.views, scene.views.image_size[1]
    intrinsics = views.intrinsics.clone()
    intrinsics[..., 0, 1] *= -1
    intrinsics[..., 0, 2] = width - intrinsics[..., 0, 2]
    picture = views.picture
    if picture is not None:
        left, top, right, bottom = picture.unbind(dim=-1)
        picture = torch.stack([width - right, top, width - left, bottom], dim=-1)
    mirror = _in_identity(_MIRROR, 4)
    pose = _product(mirror, views.world_from_camera, mirror)
    return _changed(
        scene,
        views=Views(views.images.flip(-1), intrinsics, pose, picture),
        grid_center=_product(_MIRROR, scene.grid_center[..., None])[..., 0],
        change=_mirrored,
        foreground=None if scene.foreground is None else scene.foreground.flip(-1),
    )


def color_change(
    *, brightness: float = 1.0, contrast: float = 1.0, saturation: float = 1.0, hue: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Return a change of colours as one affine map of (red, green, blue) in [0, 255].

    Applied in the order hue, saturation, contrast, brightness.

    Args:
        brightness: factor of the colour.
        contrast: factor of the distance from mid-grey.
        saturation: factor of the distance from the pixel's grey value (BT.601).
        hue: rotation about the axis red = green = blue, radians.

    Returns:
        ``(3, 3)`` matrix and ``(3,)`` offset.
    """
    # Rodrigues' formula about (1, 1, 1)/√3.
    axis = torch.tensor([[0.0, -1.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]]) / math.sqrt(3)
    rotation = torch.eye(3) * math.cos(hue) + math.sin(hue) * axis + (1 - math.cos(hue)) / 3
    saturate = saturation * torch.eye(3) + (1 - saturation) * _LUMA.expand(3, 3)
    offset = torch.full((3,), brightness * (1 - contrast) * _MID_GREY)
    return brightness * contrast * saturate @ rotation, offset


def change_colors(images: Tensor, matrix: Tensor, offset: Tensor) -> Tensor:
    """Apply an affine map to the colour of every pixel and round.

    Args:
        images: ``(..., N, 3 or 4, H, W)`` uint8; a fourth channel is a mask and stays.
        matrix: ``(3, 3)``.
        offset: ``(3,)``.

    Returns:
        uint8 of the same shape.
    """
    changed = torch.empty(images.shape, dtype=torch.uint8)
    changed[..., 3:, :, :] = images[..., 3:, :, :]
    # Half a level is added because the cast to uint8 cuts the fraction off. One image at a time stays cached.
    offset = (offset + 0.5)[:, None]
    color = torch.empty(3, math.prod(images.shape[-2:]))
    for old, new in zip(images.flatten(0, -4), changed.flatten(0, -4), strict=True):
        torch.addmm(offset, matrix, old[:3].flatten(1).float(), out=color)
        # numpy casts seven times as fast as torch.
        np.copyto(new[:3].flatten(1).numpy(), color.clamp_(0, 255).numpy(), casting="unsafe")
    return changed


def _changed(
    scene: SceneBatch,
    *,
    views: Views,
    grid_center: Tensor,
    change: Callable[[ObjectSet], ObjectSet],
    foreground: Tensor | None,
) -> SceneBatch:
    return replace(
        scene,
        views=views,
        grid_center=grid_center,
        objects=None if scene.objects is None else tuple(change(objects) for objects in scene.objects),
        occupancy=None,
        foreground=foreground,
    )


def _mirrored(objects: ObjectSet) -> ObjectSet:
    return replace(
        objects,
        center=_product(_MIRROR, objects.center[..., None])[..., 0],
        rotation=_product(_MIRROR, objects.rotation, _MIRROR),
        shape=None if objects.shape is None else objects.shape.flip(1),
        model_id=(),
    )


def _product(first: Tensor, *others: Tensor) -> Tensor:
    """Return the product of matrices, computed in float64, in the dtype of the second one."""
    product = first
    for other in others:
        product = product @ other.double()
    return product.to(others[0].dtype)


def _in_identity(block: Tensor, size: int) -> Tensor:
    """Return the identity matrix of ``size`` with ``block`` as its upper left corner."""
    matrix = torch.eye(size, dtype=block.dtype)
    matrix[: len(block), : len(block)] = block
    return matrix
