# SPDX-License-Identifier: Apache-2.0
"""What goes in and the auxiliary outputs of one scene: frames, occupancy slices, amodal masks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor

from raytran.data.views import choose_even
from raytran.pictures.overlay import frame_image
from raytran.pictures.palette import FAINT, INK
from raytran.structs import Views

_MASK = np.array([255.0, 127.0, 14.0])
_OUTLINE = np.array([255, 255, 255], dtype=np.uint8)


def draw_frames(path: Path, views: Views, *, count: int = 8, columns: int = 4) -> Path:
    """Write a contact sheet of frames of the first scene, spread over the walk, as JPEG."""
    number = views.images.shape[1]
    tiles = [frame_image(views, n) for n in choose_even(number, min(count, number)).tolist()]
    return contact_sheet(path, tiles, columns)


def draw_masks(
    path: Path, views: Views, predicted: Tensor, truth: Tensor | None, *, count: int = 4, columns: int = 4
) -> Path:
    """Write frames with the predicted foreground in orange and the true mask's outline in white, as JPEG.

    Args:
        path: the file.
        views: one scene of ``N`` frames.
        predicted: ``(N, H, W)`` probability.
        truth: ``(N, H, W)`` bool, amodal, or None.
        count: how many frames.
        columns: how many in a row.
    """
    tiles = []
    for n in choose_even(len(predicted), min(count, len(predicted))).tolist():
        image = np.asarray(frame_image(views, n)).astype(np.float32)
        share = 0.65 * predicted[n].float().cpu().numpy()[..., None]
        tile = ((1 - share) * (0.75 * image) + share * _MASK).round().astype(np.uint8)
        if truth is not None:
            inside = truth[n].cpu().numpy()
            edge = np.zeros_like(inside)
            edge[:, 1:] |= inside[:, 1:] != inside[:, :-1]
            edge[1:] |= inside[1:] != inside[:-1]
            tile[edge] = _OUTLINE
        tiles.append(Image.fromarray(tile))
    return contact_sheet(path, tiles, columns)


def draw_new_views(path: Path, seen: Views, truth: Views, rendered: Tensor, *, count: int = 4) -> Path:
    """Write some frames that were seen above photographs of new views above what was rendered, as JPEG.

    Args:
        path: the file.
        seen: one scene of ``N`` frames.
        truth: ``V`` photographs of the scene.
        rendered: ``(V, 3, H, W)`` in [0, 1].
        count: how many in a row.
    """
    pictured = replace(truth, images=rendered[None])
    tiles = []
    for views in (seen, truth, pictured):
        number = views.images.shape[1]
        shown = choose_even(number, min(count, len(rendered)))
        tiles += [frame_image(views, n) for n in shown.tolist()]
    return contact_sheet(path, tiles, columns=min(count, len(rendered)))


def draw_occupancy(
    path: Path, predicted: Tensor, truth: Tensor | None, *, height: float, slices: int = 4
) -> Path:
    """Write horizontal slices of the voxel grid, prediction above truth, north (+y) up, as PNG.

    Args:
        path: the file.
        predicted: ``(X, Y, Z)`` probability.
        truth: ``(X, Y, Z)`` bool, or None.
        height: extent of the grid along z, metres.
        slices: how many; a cell shows the highest value of its layer.
    """
    layers = predicted.float().cpu().tensor_split(slices, dim=2)
    rows = [("predicted", [layer.amax(dim=2) for layer in layers])]
    if truth is not None:
        true_layers = truth.float().cpu().tensor_split(slices, dim=2)
        rows.append(("truth", [layer.amax(dim=2) for layer in true_layers]))
    figure = Figure(figsize=(2.2 * slices, 2.3 * len(rows) + 0.2), dpi=120, layout="constrained")
    grid = figure.subplots(len(rows), slices, squeeze=False)
    edge = np.cumsum([0, *(layer.shape[2] for layer in layers)]) * height / predicted.shape[2] - height / 2
    for axes_row, (name, maps) in zip(grid, rows, strict=True):
        for axes, values in zip(axes_row, maps, strict=True):
            axes.imshow(values.T.numpy(), origin="lower", cmap="Greys", vmin=0, vmax=1)
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set_color(FAINT)
        axes_row[0].set_ylabel(name, color=INK)
    for k, axes in enumerate(grid[0]):
        axes.set_title(f"z {edge[k]:+.1f} to {edge[k + 1]:+.1f} m", color=INK, fontsize=9)
    # Maps keep their shape, so that the layout alone may push headings over the edge.
    figure.savefig(path, bbox_inches="tight", pad_inches=0.1)
    return path


def contact_sheet(
    path: Path, tiles: Sequence[Image.Image], columns: int, *, width: int = 1280, gap: int = 4
) -> Path:
    """Write pictures of one size side by side in rows, ``width`` pixels across, as JPEG."""
    tile_width = (width - gap * (columns - 1)) // columns
    tile_height = round(tiles[0].height * tile_width / tiles[0].width)
    rows = -(-len(tiles) // columns)
    across = min(columns, len(tiles))
    sheet = Image.new(
        "RGB", (across * (tile_width + gap) - gap, rows * (tile_height + gap) - gap), (255, 255, 255)
    )
    for i, tile in enumerate(tiles):
        place = ((i % columns) * (tile_width + gap), (i // columns) * (tile_height + gap))
        sheet.paste(tile.resize((tile_width, tile_height), Image.Resampling.LANCZOS), place)
    sheet.save(path, format="JPEG", quality=90)
    return path
