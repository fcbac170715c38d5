# SPDX-License-Identifier: Apache-2.0
"""Writers of the formats that phones and reconstruction programs write."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

DISPLAY_MATRICES = {2: (-1, 0, 0, 1), 3: (-1, 0, 0, -1), 4: (1, 0, 0, -1), 6: (0, 1, -1, 0), 8: (0, -1, 1, 0)}
"""EXIF orientation → where the display matrix of a video takes the axes of its picture."""

SCAN = "scene0000_00"
"""The scan in the room of the tests."""

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""The +y up world of ARKit from the walk's."""

MODEL_NUMBERS = {
    "PINHOLE": 1,
    "SIMPLE_RADIAL": 2,
    "OPENCV": 4,
    "OPENCV_FISHEYE": 5,
    "FULL_OPENCV": 6,
    "SIMPLE_RADIAL_FISHEYE": 8,
    "RAD_TAN_THIN_PRISM_FISHEYE": 11,
}


@dataclass(frozen=True)
class Walk:
    """A folder with ``images/``, and what is known of them: poses are OpenCV, camera is fx, fy, cx, cy."""

    folder: Path
    names: tuple[str, ...]
    poses: np.ndarray
    image_size: tuple[int, int]
    camera: tuple[float, float, float, float]


def write_colmap(
    walk: Walk, folder: Path, *, binary: bool, model: str = "PINHOLE", parameters=None, cameras=1
) -> None:
    """Write ``cameras`` and ``images`` as COLMAP does, with two observed points per image."""
    folder.mkdir(parents=True)
    parameters = list(walk.camera) if parameters is None else list(parameters)
    height, width = walk.image_size
    inverse = np.linalg.inv(walk.poses)
    quaternions = Rotation.from_matrix(inverse[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    lens = [(number + 1, model, width, height, parameters) for number in range(cameras)]
    # COLMAP numbers images as it registers them, not as they are named.
    images = [
        (i + 1, quaternions[n], inverse[n, :3, 3], 1 + n % cameras, walk.names[n])
        for i, n in enumerate(reversed(range(len(walk.names))))
    ]
    if not binary:
        rows = ["# Camera list"] + [f"{c[0]} {c[1]} {c[2]} {c[3]} {words(c[4])}" for c in lens]
        (folder / "cameras.txt").write_text("\n".join(rows) + "\n")
        rows = ["# Image list"]
        for i, turn, shift, camera, name in images:
            rows += [
                f"{i} {words(turn)} {words(shift)} {camera} {name}",
                "" if i == 2 else "1.5 2.5 -1 3.0 4.0 7",
            ]
        (folder / "images.txt").write_text("\n".join(rows) + "\n")
        return
    out = struct.pack("<Q", len(lens))
    for number, name, w, h, values in lens:
        out += struct.pack(f"<IiQQ{len(values)}d", number, MODEL_NUMBERS[name], w, h, *values)
    (folder / "cameras.bin").write_bytes(out)
    out = struct.pack("<Q", len(images))
    for i, turn, shift, camera, name in images:
        out += struct.pack("<I7dI", i, *turn, *shift, camera) + name.encode() + b"\0"
        out += struct.pack("<Q", 2) + 2 * struct.pack("<ddq", 1.5, 2.5, -1)
    (folder / "images.bin").write_bytes(out)


def transforms(walk: Walk, **changes) -> dict:
    """Return the content of a ``transforms.json``."""
    fx, fy, cx, cy = walk.camera
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": (pose @ OPENGL).tolist()}
        for name, pose in zip(walk.names, walk.poses, strict=True)
    ]
    height, width = walk.image_size
    facts = {"camera_model": "OPENCV", "w": width, "h": height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    return facts | {"frames": frames[::-1]} | changes


def write_transforms(walk: Walk, **changes) -> Path:
    """Write a ``transforms.json`` beside ``images/``."""
    path = walk.folder / "transforms.json"
    path.write_text(json.dumps(transforms(walk, **changes)))
    return path


def tum_line(time: float, pose: np.ndarray) -> str:
    """Return ``timestamp tx ty tz qx qy qz qw`` of a camera-to-world matrix."""
    turn = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return f"{time:.6f} {words(pose[:3, 3])} {words(turn)}"


def write_tum(walk: Walk, folder: Path, times, image_times=None) -> None:
    """Write ``rgb/<time>.png``, ``trajectory.txt`` and ``intrinsics.txt``."""
    (folder / "rgb").mkdir(parents=True)
    image_times = times if image_times is None else image_times
    for name, time in zip(walk.names, image_times, strict=True):
        (folder / "rgb" / f"{time:.6f}.png").write_bytes((walk.folder / "images" / name).read_bytes())
    lines = ["# ground truth"] + [tum_line(t, pose) for t, pose in zip(times, walk.poses, strict=True)]
    (folder / "trajectory.txt").write_text("\n".join(lines) + "\n")
    (folder / "intrinsics.txt").write_text(words(walk.camera))


def write_video(walk: Walk, path: Path, *, rate: int = 10, size=None, turn: int = 1, times=None) -> None:
    """Encode the walk's images as a video without loss of a grey level, with a frame every 1 / rate s.

    Args:
        walk: with its images.
        path: of the video.
        rate: frames a second.
        size: ``(H, W)`` that is coded; None: the images'.
        turn: EXIF orientation by which the frames, coded as its images are, are to be displayed.
        times: of the frames, milliseconds, instead of the rate.
    """
    import av
    from PIL import Image

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=rate, options={"crf": "4", "g": "5", "bf": "2"})
        stream.height, stream.width = size or walk.image_size
        stream.pix_fmt = "yuv420p"
        if times is not None:
            stream.codec_context.time_base = Fraction(1, 1000)
        for n, name in enumerate(walk.names):
            with Image.open(walk.folder / "images" / name) as image:
                frame = av.VideoFrame.from_image(image.convert("RGB"))
            if times is not None:
                frame.pts, frame.time_base = int(times[n]), Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    if turn != 1:
        content = bytearray(path.read_bytes())
        at = content.find(b"tkhd") + 44
        a, b, c, d = (value << 16 for value in DISPLAY_MATRICES[turn])
        struct.pack_into(">9i", content, at, a, b, 0, c, d, 0, 0, 0, 1 << 30)
        path.write_bytes(content)


def write_stray(walk: Walk, folder: Path) -> Path:
    """Write ``odometry.csv``, ``camera_matrix.csv`` and ``rgb/`` as Stray Scanner does, in ARKit's world."""
    (folder / "rgb").mkdir(parents=True)
    fx, fy, cx, cy = walk.camera
    (folder / "camera_matrix.csv").write_text(f"{fx}, 0, {cx}\n0, {fy}, {cy}\n0, 0, 1\n")
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for n, (name, pose) in enumerate(zip(walk.names, Y_UP @ walk.poses, strict=True)):
        turn = Rotation.from_matrix(pose[:3, :3]).as_quat()
        rows.append(", ".join([str(n / 60), f"{n:06d}", *words([*pose[:3, 3], *turn]).split()]))
        (folder / "rgb" / f"{n:06d}.png").write_bytes((walk.folder / "images" / name).read_bytes())
    (folder / "odometry.csv").write_text("\n".join(rows) + "\n")
    return folder


def check_frames(scan, walk: Walk, numbers=None, *, turn=None) -> None:
    """Hold the poses of a scan against the walk's, by the grey of each image, which tells its number."""
    found = [round(float(scan.read_color(i)[24, 32, 0]) / 20) for i in range(len(scan))]
    assert sorted(found) == sorted(range(len(walk.names)) if numbers is None else numbers)
    poses = walk.poses[found] if turn is None else turn @ walk.poses[found]
    np.testing.assert_allclose(scan.world_from_camera.numpy(), poses, atol=1e-6)


def words(values) -> str:
    return " ".join(repr(float(value)) for value in values)
