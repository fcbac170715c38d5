# SPDX-License-Identifier: Apache-2.0
"""What ``raytran poses`` found, in one picture: ``python docs/poses_picture.py SCAN PICTURE.jpg``.

Frames of the film above; below the cameras and the points they share, from above and from the side.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pycolmap
from PIL import Image

mpl.use("Agg")
import matplotlib.pyplot as plt

FRAMES = 6


def cameras(content: dict) -> np.ndarray:
    """Return ``(n, 4, 4)`` camera-to-world of a ``transforms.json``, OpenGL axes."""
    return np.array([frame["transform_matrix"] for frame in content["frames"]])


def points(scan: Path, content: dict) -> np.ndarray:
    """Return the points ``(p, 3)`` of the largest model, brought to the world of ``transforms.json``."""
    models = [pycolmap.Reconstruction(folder) for folder in scan.glob("work/models/*/*") if folder.is_dir()]
    model = max(models, key=lambda model: model.num_reg_images())
    first = next(image for image in model.images.values() if image.has_pose)
    listed = next(f for f in content["frames"] if Path(f["file_path"]).name == first.name)
    pose = np.array(listed["transform_matrix"])
    in_camera = first.cam_from_world() * np.array([point.xyz for point in model.points3D.values()])
    in_camera = in_camera * content["raytran_world"]["scale"] * [1, -1, -1]
    return in_camera @ pose[:3, :3].T + pose[:3, 3]


def draw(scan: Path) -> plt.Figure:
    """Return the picture."""
    content = json.loads((scan / "transforms.json").read_text())
    poses, cloud = cameras(content), points(scan, content)
    eye, forward = poses[:, :3, 3], -poses[:, :3, 2]
    low, high = np.quantile(cloud, 0.01, axis=0) - 0.3, np.quantile(cloud, 0.99, axis=0) + 0.3
    cloud = cloud[((cloud > low) & (cloud < high)).all(axis=1)]
    figure = plt.figure(figsize=(11, 6.2), layout="constrained")
    grid = figure.add_gridspec(2, FRAMES, height_ratios=[1, 2.3])
    names = [frame["file_path"] for frame in content["frames"]]
    chosen = np.linspace(0, len(names) - 1, FRAMES).round().astype(int)
    for column, number in enumerate(chosen):
        axes = figure.add_subplot(grid[0, column])
        axes.imshow(Image.open(scan / names[number]))
        axes.set_title(Path(names[number]).name, fontsize=8)
        axes.axis("off")
    half = FRAMES // 2
    for place, (a, b), title in (
        (grid[1, :half], (0, 1), "from above, metres"),
        (grid[1, half:], (0, 2), "from the side, metres"),
    ):
        axes = figure.add_subplot(place)
        axes.scatter(cloud[:, a], cloud[:, b], s=1.5, c="#9aa5b1", linewidths=0)
        axes.plot(eye[:, a], eye[:, b], color="#0b7285", linewidth=1)
        axes.quiver(
            *(eye[::4, a], eye[::4, b], forward[::4, a], forward[::4, b]),
            **{"color": "#e8590c", "width": 0.003, "scale": 14, "zorder": 3},
        )
        axes.set_aspect("equal")
        axes.set_title(title, fontsize=9)
        axes.tick_params(labelsize=8)
    return figure


if __name__ == "__main__":
    source, target = map(Path, sys.argv[1:])
    draw(source).savefig(target, dpi=100, pil_kwargs={"quality": 85, "optimize": True})
