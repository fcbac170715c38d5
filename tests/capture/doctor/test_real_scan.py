# SPDX-License-Identifier: Apache-2.0
"""A real ScanNet scan with real CADs, and copies of it that are spoiled as people spoil them."""

from __future__ import annotations

import hashlib
import json
import os
import shutil

import numpy as np
import pytest
from skimage.feature import ORB

from raytran.capture.doctor import matches
from raytran.capture.doctor.examine import examine
from raytran.data.scan2cad import read_annotations
from raytran.data.scannet.find import find_scans

from ..forms import OPENGL

SCAN = "scene0470_00"

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", autouse=True)
def features_once():
    """What is spoiled is never an image: copies have the same features, which take the longest to find."""
    known = {}

    class Known(ORB):
        def detect_and_extract(self, image):
            key = hashlib.sha256(image.tobytes()).digest()
            if key not in known:
                super().detect_and_extract(image)
                known[key] = self.keypoints, self.descriptors
            self.keypoints, self.descriptors = known[key]

    with pytest.MonkeyPatch.context() as context:
        context.setattr(matches, "ORB", Known)
        yield


@pytest.fixture
def copy(shared_dir, tmp_path):
    """A copy of links; what is spoiled is written anew."""
    source = shared_dir / "realdata" / SCAN
    return shutil.copytree(source, tmp_path / "copy", copy_function=os.symlink)


def rewrite(path, text):
    path.unlink()
    path.write_text(text)


def poses(change):
    def spoil(root):
        for path in (root / "scannet" / "scans" / SCAN / "pose").iterdir():
            pose = np.loadtxt(path)
            if np.isfinite(pose).all():
                path.unlink()
                np.savetxt(path, change(pose))

    return spoil


def centimetres(pose):
    return np.block([[pose[:3, :3], 100 * pose[:3, 3:]], [pose[3:]]])


def aligned_twice(root):
    text = (root / "scannet" / "scans" / SCAN / f"{SCAN}.txt").read_text()
    line = next(line for line in text.splitlines() if line.startswith("axisAlignment"))
    matrix = np.array([float(word) for word in line.split("=")[1].split()]).reshape(4, 4)
    poses(lambda pose: matrix @ matrix @ pose)(root)


def intrinsics(x, y):
    def spoil(root):
        path = root / "scannet" / "scans" / SCAN / "intrinsic" / "intrinsic_color.txt"
        matrix = np.diag([x, y, 1, 1]) @ np.loadtxt(path)
        path.unlink()
        np.savetxt(path, matrix)

    return spoil


def mirrored(axis):
    def spoil(root):
        for path in root.glob("shapenet/*/*/models/model_normalized.obj"):
            lines = path.read_text().splitlines()
            for i, line in enumerate(lines):
                if line.startswith("v "):
                    words = line.split()
                    words[1 + axis] = str(-float(words[1 + axis]))
                    lines[i] = " ".join(words)
            rewrite(path, "\n".join(lines) + "\n")

    return spoil


def negative_scale(root):
    path = root / "scan2cad" / "full_annotations.json"
    entries = json.loads(path.read_text())
    for model in entries[0]["aligned_models"]:
        model["trs"]["scale"][0] *= -1
    rewrite(path, json.dumps(entries))


def causes(root):
    annotation = read_annotations(root / "scan2cad" / "full_annotations.json")[SCAN]
    result = examine(find_scans(root)[SCAN][0], annotation=annotation, shapenet_root=root / "shapenet")
    return [finding.cause for finding in result.faults]


def test_the_true_scans_are_not_flagged(shared_dir):
    assert causes(shared_dir / "realdata" / SCAN) == []
    lounge = find_scans(shared_dir / "realdata" / "hololens_lounge")
    result = examine(next(iter(lounge.values()))[0])
    assert result.faults == ()
    assert all(finding.state in ("ok", "note") for finding in result.findings)


@pytest.mark.parametrize(
    ("spoil", "cause"),
    [
        (poses(np.linalg.inv), "inverted poses"),
        (poses(lambda pose: pose @ OPENGL), "OpenGL camera axes"),
        (poses(centimetres), "positions in centimetres"),
        (intrinsics(1296 / 640, 968 / 480), "intrinsics for another image size"),
        (intrinsics(0.9, 0.9), "intrinsics for another image size"),
        (aligned_twice, "axisAlignment applied twice (to the cameras)"),
        (mirrored(0), "mirrored CADs"),
        (mirrored(2), "mirrored CADs"),
        (negative_scale, "mirrored CADs (negative scale)"),
    ],
)
def test_each_spoiled_copy_is_flagged_with_the_right_cause(copy, spoil, cause):
    spoil(copy)
    assert causes(copy) == [cause]
