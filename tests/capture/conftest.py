# SPDX-License-Identifier: Apache-2.0
"""A walk with plain images, known poses and a pinhole camera; and a furnished room that may be spoiled."""

from __future__ import annotations

import shutil
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from raytran.capture.doctor.matches import match_frames
from raytran.capture.frames import RawScan, read_grey
from raytran.capture.lens import _unit_camera, load_pycolmap
from raytran.data.scannet.scan import read_scan

from .forms import SCAN, Walk


@pytest.fixture
def walk(tmp_path: Path) -> Walk:
    """Twelve level cameras 1.5 m up that turn about while they go; +z is up, units are metres."""
    images = tmp_path / "walk" / "images"
    images.mkdir(parents=True)
    poses = np.tile(np.eye(4), (12, 1, 1))
    for n, pose in enumerate(poses):
        yaw, pitch = 0.5 * n, 0.2 * np.sin(n)
        forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
        right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = [0.3 * n, 0.5 * np.cos(n), 1.5 + 0.05 * np.sin(2 * n)]
        # Grey 20 n, so that a frame tells its number; names do not sort as text.
        Image.new("RGB", (64, 48), (20 * n,) * 3).save(images / f"{n}.png")
    return Walk(
        images.parent, tuple(f"{n}.png" for n in range(12)), poses, (48, 64), (50.0, 51.0, 31.0, 25.0)
    )


@pytest.fixture
def without_pycolmap(monkeypatch):
    """An installation without the extra ``colmap``."""
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    load_pycolmap.cache_clear()
    _unit_camera.cache_clear()
    yield
    load_pycolmap.cache_clear()


@pytest.fixture(scope="session")
def raw(room):
    """The scan of a furnished room."""
    return RawScan.of(read_scan(room / "scannet" / "scans" / SCAN))


@pytest.fixture(scope="session")
def matches(raw):
    """Points matched between its frames."""
    return match_frames(partial(read_grey, raw.scan), len(raw))


@pytest.fixture
def copy(room, tmp_path):
    """A copy of the room that may be spoiled."""
    return shutil.copytree(room, tmp_path / "copy")
