# SPDX-License-Identifier: Apache-2.0
"""Joins several scenes to one batch."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

import torch
from torch import Tensor

from raytran.errors import ShapeError
from raytran.structs import SceneBatch, Views


def collate_scenes(samples: Sequence[SceneBatch]) -> SceneBatch:
    """Join batches along B; the ``collate_fn`` of a ``DataLoader`` over a ``SceneDataset``.

    Args:
        samples: at least one, with the same number and size of images and the same targets.

    Raises:
        ShapeError: the images differ in number or size.
    """
    shapes = {tuple(sample.views.images.shape[1:]) for sample in samples}
    if len(shapes) > 1:
        raise ShapeError(f"expected scenes with images of one number and size, got {sorted(shapes)}")
    if len(samples) == 1:
        # This saves a copy of all images.
        return samples[0]
    objects = [sample.objects for sample in samples]
    new_views = [sample.new_views for sample in samples]
    return SceneBatch(
        scene_id=tuple(chain.from_iterable(sample.scene_id for sample in samples)),
        views=_join_views([sample.views for sample in samples]),
        frame_id=tuple(chain.from_iterable(sample.frame_id for sample in samples)),
        grid_center=torch.cat([sample.grid_center for sample in samples]),
        objects=None if None in objects else tuple(chain.from_iterable(o for o in objects if o is not None)),
        occupancy=_join([sample.occupancy for sample in samples]),
        foreground=_join([sample.foreground for sample in samples]),
        new_views=None if None in new_views else _join_views([v for v in new_views if v is not None]),
    )


def _join_views(parts: Sequence[Views]) -> Views:
    return Views(
        images=torch.cat([views.images for views in parts]),
        intrinsics=torch.cat([views.intrinsics for views in parts]),
        world_from_camera=torch.cat([views.world_from_camera for views in parts]),
        picture=_join_pictures(parts),
    )


def _join_pictures(parts: Sequence[Views]) -> Tensor | None:
    """Return the pictures of all views, None if each image is all picture."""
    if all(views.picture is None for views in parts):
        return None
    pictures = []
    for views in parts:
        height, width = views.image_size
        whole = views.intrinsics.new_tensor([0.0, 0.0, width, height])
        pictures.append(whole.expand(*views.images.shape[:2], 4) if views.picture is None else views.picture)
    return torch.cat(pictures)


def _join(tensors: Sequence[Tensor | None]) -> Tensor | None:
    """Return the tensors joined along B, or None if a scene has none."""
    present = [tensor for tensor in tensors if tensor is not None]
    return torch.cat(present) if len(present) == len(tensors) else None
