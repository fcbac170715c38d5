# SPDX-License-Identifier: Apache-2.0
"""Predicted objects drawn over the frames they were seen in."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
import trimesh
from PIL import Image, ImageDraw
from torch import Tensor

from raytran.data.views import choose_even
from raytran.geometry.camera import Cameras
from raytran.geometry.rasterize import rasterize_ids
from raytran.pictures.labels import place_labels
from raytran.pictures.palette import font, ink_on
from raytran.pictures.wireframe import box_segments
from raytran.structs import ObjectSet, ScenePrediction, Views

Segments = Sequence[tuple[float, float, float, float, bool]]
"""Of one box, as ``box_segments`` returns them."""

_FILL = 0.5
_OVERSAMPLING = 2


def draw_overlays(
    folder: Path,
    views: Views,
    frame_ids: Sequence[str],
    prediction: ScenePrediction,
    meshes: Sequence[trimesh.Trimesh | None],
    *,
    count: int = 4,
    min_height: int = 360,
) -> list[Path]:
    """Write ``<frame>.jpg`` for a few frames spread evenly over the walk.

    Boxes are wireframes with the front face drawn bold; meshes are translucent fills; both in class colours.

    Args:
        folder: made if it is missing.
        views: one scene, B = 1.
        frame_ids: the name of each of the ``N`` frames.
        prediction: ``M`` objects.
        meshes: for each object its mesh in world coordinates, or None.
        count: how many frames; all of them if there are fewer.
        min_height: smaller frames are enlarged to this many rows, so that names can be read.

    Returns:
        The pictures in the order of the walk.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for frame, picture in overlays(views, prediction.objects, meshes, count=count, min_height=min_height):
        paths.append(folder / f"{frame_ids[frame]}.jpg")
        picture.save(paths[-1], quality=92)
    return paths


def overlays(
    views: Views,
    objects: ObjectSet,
    meshes: Sequence[trimesh.Trimesh | None],
    *,
    count: int,
    min_height: int,
) -> Iterator[tuple[int, Image.Image]]:
    """Yield a few frames with the objects drawn over them, each with its index; see ``draw_overlays``."""
    num_frames, cameras = views.images.shape[1], Cameras.of(views.scene())
    for n in dict.fromkeys(choose_even(num_frames, min(count, num_frames)).tolist()):
        frame = frame_image(views, n)
        camera = cameras[n]
        if frame.height < min_height:
            size = (min_height, round(frame.width * min_height / frame.height))
            frame, camera = frame.resize(size[::-1], Image.Resampling.BICUBIC), camera.scaled_to(size)
        yield n, draw_objects(frame, camera, objects, meshes)


def frame_image(views: Views, index: int) -> Image.Image:
    """Return the RGB picture of frame ``index`` of the first scene."""
    pixels = views.images[0, index, :3].cpu()
    if pixels.is_floating_point():
        pixels = (pixels * 255).round().clamp(0, 255).to(torch.uint8)
    return Image.fromarray(pixels.permute(1, 2, 0).numpy())


def draw_objects(
    frame: Image.Image, camera: Cameras, objects: ObjectSet, meshes: Sequence[trimesh.Trimesh | None]
) -> Image.Image:
    """Return ``frame`` with objects drawn over it.

    Args:
        frame: a picture of the camera's image size.
        camera: no leading dimensions.
        objects: ``M`` objects.
        meshes: for each object its mesh in world coordinates, or None.
    """
    filled = _fill_meshes(np.asarray(frame), camera, objects, meshes)
    large = Image.fromarray(filled).resize(
        (frame.width * _OVERSAMPLING, frame.height * _OVERSAMPLING), Image.Resampling.BICUBIC
    )
    pen = ImageDraw.Draw(large)
    segments = box_segments(objects, camera)
    camera_from_object = (objects.center - camera.position.to(objects.center)).norm(dim=-1)
    far_first = camera_from_object.argsort(descending=True).tolist()
    for m in far_first:
        color = objects.classes.colors[int(objects.label[m])]
        for u0, v0, u1, v1, front in segments[m]:
            line = [_OVERSAMPLING * value for value in (u0, v0, u1, v1)]
            pen.line(line, fill=color, width=_OVERSAMPLING * (3 if front else 1) + 1)
    picture = large.resize(frame.size, Image.Resampling.BOX)
    _write_names(picture, objects, segments, reversed(far_first))
    return picture


def _fill_meshes(
    image: np.ndarray, camera: Cameras, objects: ObjectSet, meshes: Sequence[trimesh.Trimesh | None]
) -> np.ndarray:
    shown = [(i, mesh) for i, mesh in enumerate(meshes) if mesh is not None and len(mesh.faces)]
    if not shown:
        return image
    one = camera[None]
    ids, depth = (result[0] for result in rasterize_ids([(m.vertices, m.faces) for _, m in shown], one))
    colors = torch.tensor(objects.classes.colors)[objects.label[[i for i, _ in shown]].cpu()]
    covered = ids >= 0
    edge = torch.zeros_like(covered)
    edge[:, 1:] |= ids[:, 1:] != ids[:, :-1]
    edge[1:] |= ids[1:] != ids[:-1]
    share = torch.where(edge, 0.9, _FILL)[covered][:, None]
    directions = camera.cell_rays(camera.image_size)[1][..., 0, :]
    light = torch.where(edge, 1.0, headlight(depth, directions))[covered][:, None]
    result = torch.from_numpy(image.astype(np.float32))
    result[covered] = (1 - share) * result[covered] + share * light * colors[ids[covered]]
    return result.round().to(torch.uint8).numpy()


def headlight(depth: Tensor, directions: Tensor) -> Tensor:
    """Return light by how squarely surfaces face the camera, ``(H, W)`` in [0.55, 1.1], from depths alone.

    Args:
        depth: ``(H, W)`` along the camera's z axis, metres; infinite where there is no surface.
        directions: ``(H, W, 3)`` of the pixels' rays, of unit depth, in any frame.
    """
    points = directions * depth.nan_to_num(posinf=0.0)[..., None].to(directions)
    right, down = torch.gradient(points, dim=(1, 0))
    normal = torch.nn.functional.normalize(torch.linalg.cross(right, down), dim=-1)
    sight = torch.nn.functional.normalize(directions, dim=-1)
    return (0.55 + 0.55 * (normal * sight).sum(dim=-1).abs()).float()


def _write_names(
    picture: Image.Image, objects: ObjectSet, segments: Sequence[Segments], near_first: Iterable[int]
) -> None:
    """Write the names of objects above their boxes, none on another and all in the picture."""
    pen, (width, height) = ImageDraw.Draw(picture), picture.size
    letters = font(max(13, height // 26))
    shown, anchors, sizes = [], [], []
    for m in near_first:
        ends = np.array([line[:4] for line in segments[m]]).reshape(-1, 2)
        if not len(ends):
            continue
        low, high = ends.min(axis=0), ends.max(axis=0)
        if low[0] >= width or low[1] >= height or high[0] <= 0 or high[1] <= 0:
            continue
        text = f"{objects.category[m]} {float(objects.score[m]):.2f}"
        box = pen.textbbox((0, 0), text, font=letters)
        wide, tall = box[2] - box[0] + 6, box[3] - box[1] + 6
        shown.append((m, text, box))
        sizes.append((wide, tall))
        anchors.append(((max(low[0], 0) + min(high[0], width)) / 2, low[1] - tall / 2))
    for (m, text, box), (wide, tall), (x, y) in zip(
        shown, sizes, place_labels(anchors, sizes, (1, 1, width - 1, height - 1)), strict=True
    ):
        color = objects.classes.colors[int(objects.label[m])]
        left, top = x - wide / 2, y - tall / 2
        pen.rectangle([left, top, left + wide, top + tall], fill=color)
        pen.text((left + 3 - box[0], top + 3 - box[1]), text, font=letters, fill=ink_on(color))
