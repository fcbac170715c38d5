# SPDX-License-Identifier: Apache-2.0
"""A scene seen from above: boxes, fronts, camera path, occupancy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from scipy.spatial import ConvexHull
from torch import Tensor

from raytran.classes import Classes
from raytran.geometry.camera import Cameras
from raytran.pictures.labels import place_labels
from raytran.pictures.palette import FAINT, INK
from raytran.pictures.wireframe import box_corners
from raytran.structs import ObjectSet, ScenePrediction

_MARGIN = 0.4
"""Metres of floor around everything that is drawn."""

_FRONT_MARK = 0.07
"""Half the base of the arrow head on the front edge, metres."""


def draw_topdown(
    path: Path,
    prediction: ScenePrediction,
    *,
    truth: ObjectSet | None,
    cameras: Cameras | None = None,
    title: str | None = None,
) -> Path:
    """Draw a prediction from above, north (+y) up, to scale.

    Predicted boxes are filled with their class colour; an arrow head marks the front. True boxes are dashed
    outlines in the class colour. The cameras are a line with a ring at the first and a short stroke along
    each view. Names stand on their boxes, or beside them with a line where there is no room. The highest
    predicted occupancy over each ground cell lies faintly behind.

    Args:
        path: PNG file.
        prediction: what to draw; ``occupancy`` is drawn if it is there, and ``grid_extent``.
        truth: annotated objects, or None.
        cameras: the ``(N,)`` cameras of the walk, in order, or None.
        title: heading; the scene's name and the number of objects if None.

    Returns:
        ``path``.
    """
    figure = Figure(figsize=(8.6, 7.2), dpi=130, layout="constrained", facecolor="white")
    axes = figure.add_subplot()
    objects = prediction.objects
    _draw_occupancy(axes, prediction)
    if cameras is not None:
        _draw_path(axes, cameras)
    if truth is not None:
        _draw_boxes(axes, truth, predicted=False)
    _draw_boxes(axes, objects, predicted=True)
    walk = torch.zeros(0, 3) if cameras is None else cameras.position
    _frame(axes, [objects] if truth is None else [objects, truth], walk)
    count = f"{len(objects)} object{'' if len(objects) == 1 else 's'}" if len(objects) else "no objects found"
    axes.set_title(title or f"{prediction.scene_id}: {count}", loc="left", color=INK, fontsize=13)
    present = set(objects.label.tolist()) | (set() if truth is None else set(truth.label.tolist()))
    _legend(
        axes,
        objects.classes,
        sorted(present),
        with_truth=truth is not None,
        with_cameras=cameras is not None,
    )
    _write_names(figure, axes, objects)
    figure.savefig(path, bbox_inches="tight", pad_inches=0.15)
    return path


def _draw_boxes(axes: Axes, objects: ObjectSet, *, predicted: bool) -> None:
    corners = box_corners(objects)[..., :2].double().cpu().numpy()
    fronts = (
        (objects.rotation @ torch.tensor([0.0, 0.0, -1.0]).to(objects.rotation))[:, :2].double().cpu().numpy()
    )
    depth = objects.size[:, 2].double().cpu().numpy()
    center = objects.center[:, :2].double().cpu().numpy()
    lowest_first = (objects.center[:, 2] + objects.size[:, 1] / 2).argsort().tolist()
    for i in lowest_first:
        label = int(objects.label[i])
        # A tilted box casts a hexagon; the hull of all eight corners is right for any box.
        outline = (
            corners[i][ConvexHull(corners[i]).vertices]
            if np.ptp(corners[i], axis=0).min() > 0
            else corners[i]
        )
        color = objects.classes.hex(label)
        if not predicted:
            axes.add_patch(
                Polygon(outline, fill=False, edgecolor=color, linewidth=1.8, linestyle=(0, (3, 2)), zorder=5)
            )
            continue
        strength = 0.25 + 0.45 * float(objects.score[i])
        axes.add_patch(Polygon(outline, facecolor=color, alpha=strength, edgecolor="none", zorder=3))
        axes.add_patch(Polygon(outline, fill=False, edgecolor=color, linewidth=1.6, zorder=4))
        edge = center[i] + fronts[i] * depth[i] / 2
        side = _FRONT_MARK * np.array([-fronts[i][1], fronts[i][0]])
        arrow = [edge - side, edge + side, edge + 1.2 * _FRONT_MARK * fronts[i]]
        axes.add_patch(Polygon(arrow, facecolor=INK, edgecolor="white", linewidth=0.6, zorder=6))


def _write_names(figure: Figure, axes: Axes, objects: ObjectSet) -> None:
    """Write each object's number, class and score beside the others', joined with its box if not on it."""
    if not len(objects):
        return
    names = [
        f"{i:02d} {name} {score:.2f}"
        for i, (name, score) in enumerate(zip(objects.category, objects.score.tolist(), strict=True))
    ]
    center = objects.center[:, :2].double().cpu().numpy()
    look: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 7, "color": INK, "zorder": 8}
    texts = [axes.text(x, y, name, **look) for (x, y), name in zip(center.tolist(), names, strict=True)]
    # Where things are in pixels is known once the figure is laid out.
    canvas = FigureCanvasAgg(figure)
    figure.draw_without_rendering()
    boxes = [text.get_window_extent(canvas.get_renderer()) for text in texts]
    sizes = [(box.width + 4, box.height + 4) for box in boxes]
    to_pixels, frame = axes.transData, axes.get_window_extent()
    anchors = to_pixels.transform(center)
    middles = place_labels(anchors, sizes, (frame.x0, frame.y0, frame.x1, frame.y1), marks=anchors)
    for i, (text, middle) in enumerate(zip(texts, middles, strict=True)):
        x, y = to_pixels.inverted().transform(middle).tolist()
        text.set_position((x, y))
        color = objects.classes.hex(int(objects.label[i]))
        text.set_bbox({"facecolor": "white", "alpha": 0.8, "edgecolor": color, "linewidth": 0.6, "pad": 1.0})
        if (np.abs(middle - anchors[i]) > np.array(sizes[i]) / 2).any():
            axes.plot((x, center[i, 0]), (y, center[i, 1]), color=INK, linewidth=0.7, zorder=7)
            axes.plot(*center[i], "o", color=INK, markersize=2.5, zorder=7)


def _draw_path(axes: Axes, cameras: Cameras) -> None:
    position = cameras.position.double().cpu().numpy()
    forward = cameras.world_from_camera[..., :3, 2].double().cpu().numpy()
    axes.plot(position[:, 0], position[:, 1], color=FAINT, linewidth=1.0, zorder=2)
    for start, way in zip(position, forward, strict=True):
        axes.plot(
            [start[0], start[0] + 0.15 * way[0]],
            [start[1], start[1] + 0.15 * way[1]],
            color=FAINT,
            linewidth=0.9,
        )
    axes.plot(
        position[:1, 0], position[:1, 1], "o", color=INK, markersize=6, markerfacecolor="white", zorder=6
    )


def _draw_occupancy(axes: Axes, prediction: ScenePrediction) -> None:
    extent = prediction.grid_extent
    if prediction.occupancy is None or extent is None:
        return
    highest = prediction.occupancy.float().amax(dim=2).cpu().numpy()
    x, y = (float(v) for v in prediction.grid_center[:2])
    box = (x - extent[0] / 2, x + extent[0] / 2, y - extent[1] / 2, y + extent[1] / 2)
    axes.imshow(highest.T, origin="lower", extent=box, cmap="Greys", vmin=0, vmax=1, alpha=0.35, zorder=0)


def _frame(axes: Axes, sets: list[ObjectSet], positions: Tensor) -> None:
    points = [box_corners(objects)[..., :2].reshape(-1, 2).double().cpu() for objects in sets]
    cloud = torch.cat([*points, positions[:, :2].double().cpu()])
    if not len(cloud):
        cloud = torch.zeros(1, 2)
    low, high = (cloud.amin(0) - _MARGIN).tolist(), (cloud.amax(0) + _MARGIN).tolist()
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set_xlabel("x / m", color=INK)
    axes.set_ylabel("y / m", color=INK)
    axes.tick_params(colors=FAINT, labelsize=8)
    axes.grid(color="#e6e9ee", linewidth=0.6, zorder=-1)
    axes.spines[:].set_color("#c9cfd8")


def _legend(axes: Axes, classes: Classes, labels: list[int], *, with_truth: bool, with_cameras: bool) -> None:
    entries: list[Patch | Line2D] = [
        Patch(facecolor=classes.hex(label), label=classes.names[label]) for label in labels
    ]
    if with_truth:
        entries.append(Line2D([], [], color=INK, linestyle=(0, (3, 2)), label="truth"))
    if with_cameras:
        ring: dict[str, Any] = {"marker": "o", "markeredgecolor": INK, "markerfacecolor": "white"}
        entries.append(Line2D([], [], color=FAINT, label="cameras", **ring))
    axes.legend(
        handles=entries,
        loc="center left",
        bbox_to_anchor=(1.01, 0.5),
        frameon=False,
        fontsize=9,
        labelcolor=INK,
    )
