# SPDX-License-Identifier: Apache-2.0
"""The predicted objects from all sides: one turn of a camera around them, as a moving picture."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from torch import Tensor

from raytran.geometry.camera import Cameras, pose_from_heading
from raytran.geometry.rasterize import rasterize_ids
from raytran.pictures.overlay import headlight
from raytran.pictures.palette import INK, font
from raytran.pictures.wireframe import NEAR, box_corners, box_edges
from raytran.structs import ObjectSet

SIZE = (448, 720)
"""Rows and columns of the picture."""

_FINER = 2
"""Lines are drawn on a picture this many times as large, which smooths them."""

_DISTANCE = 3.0
"""Of the camera from the middle, in units of the distance of the farthest point."""

_DOWN = math.radians(35)
"""How far the camera looks down."""

_FILLED = 0.96
"""Share of the picture that what is shown may fill."""

_SMALLEST = 0.7
"""Least distance of the farthest point from the middle, metres: a single small thing stays small."""

_MILLISECONDS = 120
_PAPER, _FLOOR, _PATH = (255, 255, 255), (221, 225, 231), (138, 148, 163)

_LETTERS = 13
"""Height of the legend's letters, pixels."""

_PIECES = 48
"""Pieces of a line, each drawn if nothing lies before its middle."""

_BEHIND = 0.03
"""A line this much behind a surface still lies on it, metres."""


class _Lines(NamedTuple):
    """``(L, 2, 3)`` ends in the world, metres; RGB colour and width of each, in finer pixels."""

    ends: Tensor
    colors: list[tuple[int, int, int]]
    widths: list[int]


def draw_turntable(
    path: Path,
    objects: ObjectSet,
    meshes: Sequence[trimesh.Trimesh | None],
    *,
    cameras: Cameras | None,
    num_frames: int = 24,
) -> Path:
    """Write an animated GIF of one turn around the objects.

    The first picture looks north (+y), as the plan does; then the camera goes clockwise as seen from above.

    Meshes are solid, boxes are wireframes with a bold front, both in class colours; the squares of the floor
    have sides of 1 m, the grey line is the path of the cameras, which may leave the picture.

    Args:
        path: the file.
        objects: ``M`` objects, possibly none.
        meshes: for each object its mesh in world coordinates, or None.
        cameras: ``(N,)`` cameras of the walk, or None.
        num_frames: pictures of a turn.

    Returns:
        ``path``.
    """
    pictures = list(turntable_frames(objects, meshes, cameras=cameras, num_frames=num_frames))
    # One palette for all pictures: colours of their own would flicker.
    sample = np.concatenate([np.asarray(picture) for picture in pictures[:: max(num_frames // 6, 1)]])
    palette = Image.fromarray(sample).quantize(256, method=Image.Quantize.MEDIANCUT)
    first, *others = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    first.save(path, save_all=True, append_images=others, duration=_MILLISECONDS, loop=0, optimize=True)
    return path


def turntable_frames(
    objects: ObjectSet,
    meshes: Sequence[trimesh.Trimesh | None],
    *,
    cameras: Cameras | None,
    num_frames: int,
) -> Iterator[Image.Image]:
    """Yield the pictures of a turn; arguments as of ``draw_turntable``."""
    corners = box_corners(objects).reshape(-1, 3).double().cpu()
    walk = torch.zeros(0, 3).double() if cameras is None else cameras.position.double().cpu()
    # The objects fill the picture; the path may leave it.
    points = corners if len(corners) else walk
    if not len(points):
        points = torch.zeros(1, 3).double()
    low, high = points.amin(dim=0), points.amax(dim=0)
    floor = float(corners[:, 2].min()) if len(corners) else float(low[2])
    lines = _lines(objects, walk, low, high, floor)
    orbit = _orbit(points, num_frames)
    shown = [(i, mesh) for i, mesh in enumerate(meshes) if mesh is not None and len(mesh.faces)]
    of_class = np.array(objects.classes.colors, dtype=np.float32)
    colors = of_class[objects.label.cpu().numpy()][[i for i, _ in shown]]
    ids, depths = rasterize_ids([(mesh.vertices, mesh.faces) for _, mesh in shown], orbit)
    # The pixels' rays in the frame of the camera, which are the same all the way round.
    upright = Cameras(orbit.intrinsics[0], torch.eye(4).double(), SIZE)
    rays = upright.cell_rays(SIZE)[1][..., 0, :].float()
    for n in range(num_frames):
        camera = orbit[n]
        picture = Image.fromarray(_solid(ids[n], depths[n], rays, colors))
        large = picture.resize((SIZE[1] * _FINER, SIZE[0] * _FINER), Image.Resampling.BICUBIC)
        _draw_lines(large, lines, camera, depths[n])
        small = large.resize(picture.size, Image.Resampling.BOX)
        _write_legend(small, objects)
        yield small


def _write_legend(picture: Image.Image, objects: ObjectSet) -> None:
    """Write how many objects of which class there are, in the colours of the classes, at the lower edge."""
    pen, letters = ImageDraw.Draw(picture), font(_LETTERS)
    entries = [
        (f"{count} {objects.classes.names[label]}", objects.classes.colors[label])
        for label, count in sorted(Counter(objects.label.tolist()).items())
    ]
    x, y = _LETTERS, picture.height - 2 * _LETTERS
    for text, color in reversed(entries):
        width = round(pen.textlength(text, font=letters)) + 2 * _LETTERS
        if x + width > picture.width:
            x, y = _LETTERS, y - round(1.5 * _LETTERS)
        pen.rectangle([x, y + 2, x + _LETTERS - 4, y + _LETTERS - 2], fill=color)
        pen.text((x + _LETTERS, y - 2), text, font=letters, fill=INK)
        x += width + _LETTERS


def _orbit(points: Tensor, num_frames: int) -> Cameras:
    """Return ``(num_frames,)`` cameras around points ``(n, 3)``, which fill the picture in one turn."""
    height, width = SIZE
    headings = math.pi / 2 - 2 * math.pi * np.arange(num_frames) / num_frames
    pose = torch.from_numpy(
        np.stack([pose_from_heading(np.zeros(3), heading, _DOWN, 0.0) for heading in headings])
    )
    center = (points.amin(dim=0) + points.amax(dim=0)) / 2
    radius = max(float((points - center).norm(dim=1).max()), _SMALLEST)
    pose[:, :3, 3] = center - _DISTANCE * radius * pose[:, :3, 2]
    right, below, ahead = ((points - pose[:, None, :3, 3]) @ pose[:, :3, :3]).unbind(-1)
    across, (top, bottom) = float((right / ahead).abs().max()), (below / ahead).aminmax()
    # Room for the legend below.
    free = height - 3 * _LETTERS
    focal = min(
        _FILLED * width / max(2 * across, 1e-3), _FILLED * free / max(float(bottom - top), 1e-3), 4.0 * width
    )
    row = free / 2 - focal * float(top + bottom) / 2
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, row], [0, 0, 1]]).double()
    return Cameras(intrinsics.expand(num_frames, 3, 3), pose, SIZE)


def _solid(ids: Tensor, depth: Tensor, rays: Tensor, colors: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return a picture ``(H, W, 3)`` of the nearest meshes, lit from the camera, on white."""
    picture = np.full((*ids.shape, 3), _PAPER, dtype=np.uint8)
    covered = ids >= 0
    if covered.any():
        # Only the part with meshes is lit.
        top, left = (int(covered.any(dim=axis).nonzero()[0]) for axis in (1, 0))
        bottom, right = (int(covered.any(dim=axis).nonzero()[-1]) + 1 for axis in (1, 0))
        window = (slice(max(top - 1, 0), bottom + 1), slice(max(left - 1, 0), right + 1))
        inside = covered[window]
        light = headlight(depth[window], rays[window])[inside].numpy()[:, None]
        picture[window][inside.numpy()] = (colors[ids[window][inside].numpy()] * light).clip(0, 255).round()
    return picture


def _lines(objects: ObjectSet, walk: Tensor, low: Tensor, high: Tensor, floor: float) -> _Lines:
    """Return the squares of the floor, the path and the boxes' edges."""
    x0, y0, _ = (low - 0.25).floor().tolist()
    x1, y1, _ = (high + 0.25).ceil().tolist()
    squares = [((x, y0, floor), (x, y1, floor)) for x in np.arange(x0, x1 + 1)]
    squares += [((x0, y, floor), (x1, y, floor)) for y in np.arange(y0, y1 + 1)]
    ends = [torch.tensor(squares, dtype=torch.float64), torch.stack([walk[:-1], walk[1:]], dim=1)]
    colors = [_FLOOR] * len(ends[0]) + [_PATH] * len(ends[1])
    widths = [1] * len(ends[0]) + [2] * len(ends[1])
    edges, front = box_edges()
    ends.append(box_corners(objects).double().cpu()[:, edges].reshape(-1, 2, 3))
    for label in objects.label.tolist():
        colors += [objects.classes.colors[label]] * len(edges)
        widths += [4 if bold else 2 for bold in front]
    return _Lines(torch.cat(ends), colors, widths)


def _draw_lines(picture: Image.Image, lines: _Lines, camera: Cameras, depth: Tensor) -> None:
    """Draw the pieces of lines that no surface hides, far ones first."""
    share = torch.linspace(0, 1, _PIECES + 1).double()[:, None]
    start, stop = lines.ends[:, None, 0], lines.ends[:, None, 1]
    pixels, far = camera.project((start + share * (stop - start)).flatten(0, 1))
    pixels, far = pixels.unflatten(0, (-1, _PIECES + 1)), far.unflatten(0, (-1, _PIECES + 1))
    middle, between = (pixels[:, :-1] + pixels[:, 1:]) / 2, (far[:, :-1] + far[:, 1:]) / 2
    height, width = camera.image_size
    column, row = middle[..., 0].long().clamp(0, width - 1), middle[..., 1].long().clamp(0, height - 1)
    shown = (between <= depth[row, column] + _BEHIND) & (far[:, :-1] > NEAR) & (far[:, 1:] > NEAR)
    # A run of pieces is one line: from the first point that is shown after one that is not, to the last.
    change = torch.diff(torch.nn.functional.pad(shown, (1, 1)).int())
    (line, begin), end = (change == 1).nonzero().T, (change == -1).nonzero()[:, 1]
    pixels = (_FINER * pixels).tolist()
    pen = ImageDraw.Draw(picture)
    for n in between[line, begin].argsort(descending=True).tolist():
        i = int(line[n])
        run = [tuple(pixels[i][k]) for k in (int(begin[n]), int(end[n]))]
        pen.line(run, fill=lines.colors[i], width=lines.widths[i])
