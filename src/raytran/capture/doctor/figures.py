# SPDX-License-Identifier: Apache-2.0
"""Pictures of one examined scan: a plan from above and the side, and frames with what should be in them."""

from __future__ import annotations

from dataclasses import dataclass
from io import BytesIO

import numpy as np
import torch
import trimesh
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.spatial import ConvexHull

from raytran.capture.doctor.examine import Examination
from raytran.capture.doctor.recording import Recording
from raytran.capture.doctor.world import measured_up
from raytran.data.shapenet.models import read_mesh
from raytran.errors import DataError
from raytran.geometry.camera import Cameras
from raytran.pictures.overlay import draw_objects
from raytran.pictures.palette import FAINT, INK, class_hex
from raytran.pictures.wireframe import NEAR, box_corners

_UP = "#d62728"
_SHOWN_POINTS, _SHOWN_RAYS = 4000, 250
_FRAME_WIDTH = 480
_RAY = 0.06
"""Length of the drawn view rays as a share of the plan's width."""


@dataclass(frozen=True)
class Sight:
    """The cameras as one reading of the files has them.

    Attributes:
        world_from_camera: ``(n, 4, 4)``.
        intrinsics: ``(3, 3)`` for the stored images.
        points: ``(p, 3)`` what the images show, in the same world and unit.
    """

    world_from_camera: NDArray[np.float64]
    intrinsics: NDArray[np.float64]
    points: NDArray[np.float64]


def sight(examination: Examination, recording: Recording, *, corrected: bool) -> Sight:
    """Return the cameras as stored, or as they should be."""
    correction, seen = examination.correction, examination.sightings
    scale = correction.scale
    poses = correction.apply(recording.stored) if corrected else recording.stored
    points = np.zeros((0, 3))
    if seen is not None and len(seen):
        step = max(1, len(seen) // _SHOWN_POINTS)
        origin, way = seen.in_world(poses)
        depth = seen.depth if corrected else seen.depth / scale
        points = (origin + way * depth[:, None])[::step]
    right = correction.intrinsics if corrected and correction.intrinsics is not None else recording.intrinsics
    return Sight(poses, right, points)


def draw_plan(examination: Examination, seen: Sight, extent: tuple[float, float, float]) -> bytes:
    """Return a PNG: cameras, view rays, boxes, the volume and up, from above and from the side."""
    figure = Figure(figsize=(11, 4.6), dpi=110, layout="constrained", facecolor="white")
    above, side = figure.subplots(1, 2, width_ratios=[1, 1])
    for axes, across, name in ((above, 1, "from above"), (side, 2, "from the side")):
        _draw_panel(axes, examination, seen, extent, across)
        axes.set_title(name, loc="left", fontsize=10, color=INK)
    _draw_up(side, seen)
    return _png(figure)


def draw_frames(
    examination: Examination, recording: Recording, seen: Sight, frames: list[int]
) -> list[bytes]:
    """Return JPEGs of frames with the floor as a grid of metres, boxes, and CADs where there are any."""
    meshes = _meshes(examination)
    height, width = recording.scan.image_size
    size = (round(height * _FRAME_WIDTH / width), _FRAME_WIDTH)
    floor = _floor(seen)
    pictures = []
    for frame in frames:
        try:
            picture = Image.fromarray(recording.scan.read_color(frame)).resize(
                size[::-1], Image.Resampling.LANCZOS
            )
        except DataError:
            picture = Image.new("RGB", size[::-1], (90, 90, 90))
        camera = Cameras(
            torch.from_numpy(seen.intrinsics),
            torch.from_numpy(seen.world_from_camera[frame]),
            (height, width),
        ).scaled_to(size)
        _draw_floor(picture, camera, floor)
        if len(examination.objects):
            picture = draw_objects(picture, camera, examination.objects, meshes)
        pictures.append(_jpeg(picture))
    return pictures


def telling_frames(
    examination: Examination, seen: Sight, image_size: tuple[int, int], count: int
) -> list[int]:
    """Return frames in which most boxes are seen, spread over the walk; evenly spread ones without boxes."""
    n = len(seen.world_from_camera)
    places = np.array_split(np.arange(n), min(count, n))
    if not len(examination.objects):
        return [int(part[len(part) // 2]) for part in places]
    cameras = Cameras(
        torch.from_numpy(seen.intrinsics).expand(n, 3, 3),
        torch.from_numpy(seen.world_from_camera),
        image_size,
    )
    pixels, depth = cameras.project(examination.objects.center.double().expand(n, -1, 3))
    size = torch.tensor([image_size[1], image_size[0]])
    inside = ((pixels > 0) & (pixels < size)).all(dim=-1) & (depth > 0.3)
    scores = inside.sum(dim=1).numpy()
    return [int(part[scores[part].argmax()]) for part in places]


def _draw_panel(
    axes: Axes, examination: Examination, seen: Sight, extent: tuple[float, float, float], across: int
) -> None:
    pair = [0, across]
    poses = seen.world_from_camera
    position, forward = poses[:, :3, 3][:, pair], poses[:, :3, 2][:, pair]
    axes.plot(*seen.points[:, pair].T, ".", color="#b9c1cc", markersize=1.2, zorder=1)
    everything = [position]
    if len(examination.objects):
        corners = box_corners(examination.objects)[..., pair].double().numpy()
        everything.append(corners.reshape(-1, 2))
        for m in range(len(corners)):
            outline = corners[m][ConvexHull(corners[m], qhull_options="QJ").vertices]
            color = class_hex(int(examination.objects.label[m]))
            axes.add_patch(Polygon(outline, facecolor=color, alpha=0.35, zorder=3))
            axes.add_patch(Polygon(outline, fill=False, edgecolor=color, linewidth=1.4, zorder=4))
    if len(seen.points):
        low, high = np.percentile(seen.points[:, pair], [1, 99], axis=0)
        everything.append(np.stack([low, high]))
    cloud = np.concatenate(everything)
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    margin = 0.06 * float((high - low).max()) + 1e-6
    ray = _RAY * float((high - low).max())
    axes.plot(*position.T, color=FAINT, linewidth=0.8, zorder=5)
    step = -(-len(position) // _SHOWN_RAYS)
    rays = np.stack([position, position + ray * forward], axis=1)[::step]
    axes.add_collection(LineCollection(list(rays), colors=INK, linewidths=0.6, zorder=5))
    axes.plot(*position[:1].T, "o", color=INK, markersize=6, markerfacecolor="white", zorder=6)
    middle = poses[:, :3, 3].mean(axis=0)[pair]
    sides = np.array(extent)[pair]
    axes.add_patch(
        Rectangle(
            (float(middle[0] - sides[0] / 2), float(middle[1] - sides[1] / 2)),
            *sides.tolist(),
            fill=False,
            edgecolor=FAINT,
            linestyle=(0, (4, 3)),
            zorder=2,
        )
    )
    axes.set(
        xlim=(low[0] - margin, high[0] + margin),
        ylim=(low[1] - margin, high[1] + margin),
        aspect="equal",
        xlabel="x",
        ylabel="xyz"[across],
    )
    axes.tick_params(colors=FAINT, labelsize=8)
    axes.grid(color="#e6e9ee", linewidth=0.6, zorder=-1)
    axes.spines[:].set_color("#c9cfd8")


def _draw_up(axes: Axes, seen: Sight) -> None:
    """Draw where up is by the cameras, at the mean camera; nothing if they do not tell."""
    poses = seen.world_from_camera
    measured, _ = measured_up(poses)
    if measured is None:
        return
    up, start = measured[[0, 2]], poses[:, :3, 3].mean(axis=0)[[0, 2]]
    low, high = axes.get_ylim()
    length = 0.3 * (high - low)
    tip = float(start[1] + 1.25 * length * up[1])
    axes.set_ylim(min(low, tip), max(high, tip))
    axes.annotate(
        "up",
        xy=tuple(start),
        xytext=tuple(start + length * up),
        color=_UP,
        ha="center",
        va="center",
        zorder=8,
        arrowprops={"arrowstyle": "<-", "color": _UP, "linewidth": 2},
    )


def _floor(seen: Sight) -> tuple[NDArray[np.float64], float]:
    """Return the middle of the walk and the height of the lowest things seen."""
    middle = seen.world_from_camera[:, :3, 3].mean(axis=0)
    height = float(np.percentile(seen.points[:, 2], 1)) if len(seen.points) > 50 else 0.0
    return middle, height


def _draw_floor(picture: Image.Image, camera: Cameras, floor: tuple[NDArray[np.float64], float]) -> None:
    """Draw a grid of one metre on the floor, eight metres wide."""
    middle, height = floor
    pen = ImageDraw.Draw(picture, "RGBA")
    base, line = np.floor(middle[:2]) - 4, np.arange(9.0)
    along = np.linspace(0, 8, 81)
    for axis in (0, 1):
        for offset in line:
            points = np.full((len(along), 3), height)
            points[:, axis] = base[axis] + offset
            points[:, 1 - axis] = base[1 - axis] + along
            pixels, depth = camera.project(torch.from_numpy(points))
            for i in range(len(along) - 1):
                if min(depth[i], depth[i + 1]) > NEAR:
                    pen.line(
                        [*pixels[i].tolist(), *pixels[i + 1].tolist()], fill=(255, 255, 255, 150), width=1
                    )


def _meshes(examination: Examination) -> list[trimesh.Trimesh | None]:
    """Return the CAD of each box in the world; None where it cannot be read or was left out."""
    annotation, root = examination.annotation, examination.shapenet_root
    count = len(examination.objects)
    if annotation is None or root is None or len(annotation.model_id) != count:
        return [None] * count
    meshes: list[trimesh.Trimesh | None] = []
    objects = examination.objects
    for i, model in enumerate(objects.model_id):
        try:
            mesh = read_mesh(root, *model.split("/"))
        except DataError:
            meshes.append(None)
            continue
        # By way of the box, so that whatever was found about the boxes holds for the meshes.
        unit = (mesh.vertices - annotation.box_center[i].numpy()) / (2 * annotation.box_half_size[i].numpy())
        size, turn, center = (
            part[i].double().numpy() for part in (objects.size, objects.rotation, objects.center)
        )
        placed = (np.nan_to_num(unit, posinf=0.0, neginf=0.0) * size) @ turn.T + center
        meshes.append(trimesh.Trimesh(placed, mesh.faces, process=False))
    return meshes


def _png(figure: Figure) -> bytes:
    target = BytesIO()
    figure.savefig(target, format="png")
    return target.getvalue()


def _jpeg(picture: Image.Image) -> bytes:
    target = BytesIO()
    picture.save(target, format="JPEG", quality=82)
    return target.getvalue()
