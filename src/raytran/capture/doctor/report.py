# SPDX-License-Identifier: Apache-2.0
"""The data doctor's page: the findings of each scan, what to do, and pictures that show it.

The pictures are a plan from above and from the side, and frames with the boxes and CADs drawn into them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path

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
from raytran.capture.doctor.finding import Finding
from raytran.capture.frames import RawScan
from raytran.capture.orientation import measured_up
from raytran.data.shapenet.models import read_mesh
from raytran.errors import DataError
from raytran.geometry.camera import Cameras
from raytran.pictures.overlay import draw_objects
from raytran.pictures.page import data_uri, write_page
from raytran.pictures.palette import FAINT, INK
from raytran.pictures.wireframe import NEAR, box_corners

_SHOWN_FRAMES = 3
_MAX_PICTURED = 12
"""Scans that get pictures, those with faults first; a page of a thousand would not open."""

_STATE_WORDS = {"fault": "mend", "unknown": "not all told", "ok": "right"}
_UP_COLOR = "#d62728"
_MAX_POINTS, _MAX_RAYS = 4000, 250
_FRAME_WIDTH = 480
_RAY_LENGTH = 0.06
"""Length of the strokes that show where cameras look, as a share of the plan's width."""


@dataclass(frozen=True)
class _Pictures:
    """A plan (PNG) and named frames (JPEG) of one reading of the cameras."""

    title: str
    plan: bytes
    frames: Sequence[tuple[str, bytes]]


@dataclass(frozen=True)
class _ScanSection:
    """What the template shows of a scan: the row in the table of all scans, and its section."""

    scene_id: str
    state: str
    word: str
    facts: str
    faults: Sequence[Finding]
    findings: Sequence[Finding]
    pictures: Sequence[_Pictures]


@dataclass(frozen=True)
class CameraReading:
    """The cameras as one reading of the files has them.

    Attributes:
        world_from_camera: ``(n, 4, 4)``.
        intrinsics: ``(n, 3, 3)`` for the stored images.
        points: ``(p, 3)`` what the images show, in the same world and unit.
    """

    world_from_camera: NDArray[np.float64]
    intrinsics: NDArray[np.float64]
    points: NDArray[np.float64]


def write_doctor_page(
    path: Path,
    examinations: Sequence[Examination],
    *,
    checked: Path,
    num_found: int,
    grid_extent: tuple[float, float, float],
) -> Path:
    """Write one HTML page that needs no other file; it appears whole or not at all.

    Args:
        path: the file.
        examinations: of each scan.
        checked: the folder that was given.
        num_found: scans in it, of which some may not have been examined.
        grid_extent: of the model's volume, metres.

    Returns:
        ``path``.
    """
    ordered = sorted(examinations, key=lambda examination: not examination.faults)
    return write_page(
        path,
        "doctor.html.j2",
        filters={name: partial(data_uri, media=f"image/{name}") for name in ("png", "jpeg")},
        title=f"Data doctor: {checked.resolve().name}",
        summary=summary(examinations, checked, num_found),
        scans=[
            _section(examination, grid_extent, pictured=i < _MAX_PICTURED)
            for i, examination in enumerate(ordered)
        ],
    )


def summary(examinations: Sequence[Examination], checked: Path, num_found: int) -> str:
    """Return one or two sentences on all scans."""
    faulty = sum(1 for examination in examinations if examination.faults)
    text = f"{len(examinations)} scan{'' if len(examinations) == 1 else 's'} of {checked}"
    if num_found > len(examinations):
        text += f" (spread evenly over all {num_found}; checks=N looks at more)"
    if not faulty:
        return f"{text}: nothing to mend was found."
    return f"{text}: {faulty} {'has' if faulty == 1 else 'have'} something to mend."


def _section(examination: Examination, extent: tuple[float, float, float], *, pictured: bool) -> _ScanSection:
    states = {finding.state for finding in examination.findings}
    state = next((state for state in ("fault", "unknown") if state in states), "ok")
    facts = str(examination.path)
    pictures: list[_Pictures] = []
    raw = examination.raw
    if raw is not None:
        height, width = raw.scan.image_size
        facts += (
            f": {len(raw)} frames of {width}x{height}, {len(examination.objects)} annotated objects, "
            f"{examination.num_matches} points matched, {examination.seconds:.1f} s"
        )
    if raw is not None and pictured:
        is_changed = examination.correction.changes_cameras
        title = "Cameras and boxes" if len(examination.objects) else "Cameras"
        title = "As stored" if is_changed else title
        pictures.append(_draw_reading(examination, raw, extent, title, corrected=False))
        if is_changed:
            pictures.append(_draw_reading(examination, raw, extent, "With the changes above", corrected=True))
    return _ScanSection(
        examination.scene_id,
        state,
        _STATE_WORDS[state],
        facts,
        examination.faults,
        examination.findings,
        pictures,
    )


def _draw_reading(
    examination: Examination,
    raw: RawScan,
    extent: tuple[float, float, float],
    title: str,
    *,
    corrected: bool,
) -> _Pictures:
    cameras = camera_reading(examination, raw, corrected=corrected)
    # The same frames for both readings: those that show boxes once all is right.
    right = camera_reading(examination, raw, corrected=True)
    frames = frames_to_show(examination, right, raw.scan.image_size, _SHOWN_FRAMES)
    images = draw_frames(examination, raw, cameras, frames)
    names = [raw.scan.frame_id[frame] for frame in frames]
    plan = draw_plan(examination, cameras, extent)
    return _Pictures(title, plan, list(zip(names, images, strict=True)))


def camera_reading(examination: Examination, raw: RawScan, *, corrected: bool) -> CameraReading:
    """Return the cameras as stored, or as they should be."""
    correction, surface = examination.correction, examination.surface
    poses = correction.apply(raw.stored) if corrected else raw.stored
    points = np.zeros((0, 3))
    if surface is not None and len(surface):
        step = max(1, len(surface) // _MAX_POINTS)
        origin, direction = surface.rays_in_world(poses)
        # Depths are in metres, stored poses in their own unit.
        depth = surface.depth if corrected else surface.depth / correction.scale
        points = (origin + direction * depth[:, None])[::step]
    intrinsics = raw.intrinsics
    if corrected and correction.intrinsics is not None:
        intrinsics = correction.intrinsics
    return CameraReading(poses, intrinsics, points)


def frames_to_show(
    examination: Examination, cameras: CameraReading, image_size: tuple[int, int], count: int
) -> list[int]:
    """Return up to ``count`` frames, spread over the walk; in each section the one that shows most boxes."""
    n = len(cameras.world_from_camera)
    sections = np.array_split(np.arange(n), min(count, n))
    if not len(examination.objects):
        return [int(section[len(section) // 2]) for section in sections]
    batched = Cameras(
        torch.from_numpy(cameras.intrinsics),
        torch.from_numpy(cameras.world_from_camera),
        image_size,
    )
    pixels, depth = batched.project(examination.objects.center.double().expand(n, -1, 3))
    size = torch.tensor([image_size[1], image_size[0]])
    is_seen = ((pixels > 0) & (pixels < size)).all(dim=-1) & (depth > 0.3)
    num_seen = is_seen.sum(dim=1).numpy()
    return [int(section[num_seen[section].argmax()]) for section in sections]


def draw_plan(examination: Examination, cameras: CameraReading, extent: tuple[float, float, float]) -> bytes:
    """Return a PNG: cameras and where they look, boxes, the volume and up, from above and from the side."""
    figure = Figure(figsize=(11, 4.6), dpi=110, layout="constrained", facecolor="white")
    above, side = figure.subplots(1, 2, width_ratios=[1, 1])
    for axes, vertical, name in ((above, 1, "from above"), (side, 2, "from the side")):
        _draw_panel(axes, examination, cameras, extent, vertical)
        axes.set_title(name, loc="left", fontsize=10, color=INK)
    _draw_up(side, cameras)
    png = BytesIO()
    figure.savefig(png, format="png")
    return png.getvalue()


def draw_frames(
    examination: Examination, raw: RawScan, cameras: CameraReading, frames: list[int]
) -> list[bytes]:
    """Return JPEGs of frames with the floor as a grid of metres, boxes, and CADs where there are any."""
    meshes = _meshes(examination)
    height, width = raw.scan.image_size
    size = (round(height * _FRAME_WIDTH / width), _FRAME_WIDTH)
    jpegs = []
    for frame in frames:
        try:
            color = Image.fromarray(raw.scan.read_color(frame))
            picture = color.resize(size[::-1], Image.Resampling.LANCZOS)
        except DataError:
            picture = Image.new("RGB", size[::-1], (90, 90, 90))
        camera = Cameras(
            torch.from_numpy(cameras.intrinsics[frame]),
            torch.from_numpy(cameras.world_from_camera[frame]),
            (height, width),
        ).scaled_to(size)
        _draw_floor(picture, camera, cameras)
        if len(examination.objects):
            picture = draw_objects(picture, camera, examination.objects, meshes)
        jpeg = BytesIO()
        picture.save(jpeg, format="JPEG", quality=82)
        jpegs.append(jpeg.getvalue())
    return jpegs


def _draw_panel(
    axes: Axes,
    examination: Examination,
    cameras: CameraReading,
    extent: tuple[float, float, float],
    vertical: int,
) -> None:
    """Draw one projection of the scan: world axis x to the right, axis ``vertical`` (1 or 2) up."""
    pair = [0, vertical]
    poses = cameras.world_from_camera
    position, forward = poses[:, :3, 3][:, pair], poses[:, :3, 2][:, pair]
    axes.plot(*cameras.points[:, pair].T, ".", color="#b9c1cc", markersize=1.2, zorder=1)
    # What must be within the limits of the axes.
    extremes = [position]
    if len(examination.objects):
        corners = box_corners(examination.objects)[..., pair].double().numpy()
        extremes.append(corners.reshape(-1, 2))
        for points, label in zip(corners, examination.objects.label.tolist(), strict=True):
            outline = points[ConvexHull(points, qhull_options="QJ").vertices]
            color = examination.objects.classes.hex(label)
            axes.add_patch(Polygon(outline, facecolor=color, alpha=0.35, zorder=3))
            axes.add_patch(Polygon(outline, fill=False, edgecolor=color, linewidth=1.4, zorder=4))
    if len(cameras.points):
        extremes.append(np.percentile(cameras.points[:, pair], [1, 99], axis=0))
    low, high = np.concatenate(extremes).min(axis=0), np.concatenate(extremes).max(axis=0)
    length = float((high - low).max())
    margin = 0.06 * length + 1e-6
    axes.plot(*position.T, color=FAINT, linewidth=0.8, zorder=5)
    step = -(-len(position) // _MAX_RAYS)
    rays = np.stack([position, position + _RAY_LENGTH * length * forward], axis=1)[::step]
    axes.add_collection(LineCollection(list(rays), colors=INK, linewidths=0.6, zorder=5))
    axes.plot(*position[:1].T, "o", color=INK, markersize=6, markerfacecolor="white", zorder=6)
    middle = poses[:, :3, 3].mean(axis=0)[pair]
    sides = np.array(extent)[pair]
    corner_x, corner_y = (middle - sides / 2).tolist()
    volume = Rectangle(
        (corner_x, corner_y), *sides.tolist(), fill=False, edgecolor=FAINT, linestyle=(0, (4, 3)), zorder=2
    )
    axes.add_patch(volume)
    axes.set(
        xlim=(low[0] - margin, high[0] + margin),
        ylim=(low[1] - margin, high[1] + margin),
        aspect="equal",
        xlabel="x",
        ylabel="xyz"[vertical],
    )
    axes.tick_params(colors=FAINT, labelsize=8)
    axes.grid(color="#e6e9ee", linewidth=0.6, zorder=-1)
    axes.spines[:].set_color("#c9cfd8")


def _draw_up(axes: Axes, cameras: CameraReading) -> None:
    """Draw where up is by the cameras, at the mean camera; nothing if they do not tell."""
    poses = cameras.world_from_camera
    measured = measured_up(poses)
    if measured is None:
        return
    up, start = measured.direction[[0, 2]], poses[:, :3, 3].mean(axis=0)[[0, 2]]
    low, high = axes.get_ylim()
    length = 0.3 * (high - low)
    tip = float(start[1] + 1.25 * length * up[1])
    axes.set_ylim(min(low, tip), max(high, tip))
    axes.annotate(
        "up",
        xy=tuple(start),
        xytext=tuple(start + length * up),
        color=_UP_COLOR,
        ha="center",
        va="center",
        zorder=8,
        arrowprops={"arrowstyle": "<-", "color": _UP_COLOR, "linewidth": 2},
    )


def _draw_floor(picture: Image.Image, camera: Cameras, cameras: CameraReading) -> None:
    """Draw a grid of one metre at the height of the lowest things seen, eight metres wide around the walk."""
    middle = cameras.world_from_camera[:, :3, 3].mean(axis=0)
    height = float(np.percentile(cameras.points[:, 2], 1)) if len(cameras.points) > 50 else 0.0
    pen = ImageDraw.Draw(picture, "RGBA")
    base = np.floor(middle[:2]) - 4
    along = np.linspace(0, 8, 81)
    for axis in (0, 1):
        for offset in range(9):
            points = np.full((len(along), 3), height)
            points[:, axis] = base[axis] + offset
            points[:, 1 - axis] = base[1 - axis] + along
            pixels, depth = camera.project(torch.from_numpy(points))
            # In short pieces, so that a line that passes the camera is drawn as far as it is ahead.
            for i in range(len(along) - 1):
                if min(depth[i], depth[i + 1]) > NEAR:
                    pen.line(
                        [*pixels[i].tolist(), *pixels[i + 1].tolist()], fill=(255, 255, 255, 150), width=1
                    )


def _meshes(examination: Examination) -> list[trimesh.Trimesh | None]:
    """Return the CAD of each box in the world; None where it cannot be read or was left out."""
    annotation, root, objects = examination.annotation, examination.shapenet_root, examination.objects
    if annotation is None or root is None or len(annotation.model_id) != len(objects):
        return [None] * len(objects)
    meshes: list[trimesh.Trimesh | None] = []
    for i, model in enumerate(objects.model_id):
        try:
            mesh = read_mesh(root, *model.split("/"))
        except DataError:
            meshes.append(None)
            continue
        # By way of the unit box, so that whatever was found about the boxes holds for the meshes.
        unit = (mesh.vertices - annotation.box_center[i].numpy()) / (2 * annotation.box_half_size[i].numpy())
        size, rotation, center = (
            tensor[i].double().numpy() for tensor in (objects.size, objects.rotation, objects.center)
        )
        vertices = (np.nan_to_num(unit, posinf=0.0, neginf=0.0) * size) @ rotation.T + center
        meshes.append(trimesh.Trimesh(vertices, mesh.faces, process=False))
    return meshes
