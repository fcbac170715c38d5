# SPDX-License-Identifier: Apache-2.0
"""A turn around the objects: who is where on which side, what hides what."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image, ImageDraw

from raytran.classes import PAPER_CLASSES
from raytran.geometry.camera import Cameras
from raytran.pictures.turntable import SIZE, draw_turntable, turntable_frames
from raytran.structs import ObjectSet

CHAIR, SOFA = 3, 5
LEGEND = 30
UPRIGHT = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def objects(*places: tuple[int, list[float], list[float]]) -> ObjectSet:
    """Upright objects of a label, centre and size each."""
    labels, centers, sizes = zip(*places, strict=True)
    count = len(places)
    return ObjectSet(
        label=torch.tensor(labels),
        center=torch.tensor(centers),
        size=torch.tensor(sizes),
        rotation=UPRIGHT.expand(count, 3, 3),
        symmetry=torch.ones(count, dtype=torch.int64),
        score=torch.ones(count),
    )


@pytest.fixture
def walk() -> Cameras:
    pose = torch.eye(4)[None].repeat(2, 1, 1)
    pose[:, 0, 3] = torch.tensor([-0.1, 0.1])
    pose[:, 2, 3] = 0.5
    intrinsics = torch.tensor([[100.0, 0, 80], [0, 100, 60], [0, 0, 1]]).expand(2, 3, 3)
    return Cameras(intrinsics, pose, (120, 160))


def pixels_of(picture: Image.Image, label: int) -> np.ndarray:
    """Return ``(n, 2)`` row and column of the pixels above the legend in the hue of a class."""
    values = np.asarray(picture).astype(float)[:-LEGEND]
    color = np.array(PAPER_CLASSES.colors[label], dtype=float)
    # By direction in RGB, as light scales it.
    cosine = (values @ color) / np.linalg.norm(values, axis=-1).clip(1) / np.linalg.norm(color)
    return np.argwhere(cosine > 0.985)


def ball(center: list[float], radius: float = 0.4) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    mesh.apply_translation(center)
    return mesh


def test_each_side_is_seen_in_turn(walk):
    room = objects((CHAIR, [-1.5, 0, 0.4], [0.8] * 3), (SOFA, [1.5, 0, 0.4], [0.8] * 3))
    meshes = [ball([-1.5, 0, 0.4]), ball([1.5, 0, 0.4])]
    north, east, south, _ = turntable_frames(room, meshes, cameras=walk, num_frames=4)
    assert north.size == SIZE[::-1]
    chair, sofa = (pixels_of(north, label) for label in (CHAIR, SOFA))
    # Looking north the chair, at -x, is left of the sofa, both as high and as large.
    assert chair[:, 1].max() < sofa[:, 1].min()
    assert abs(chair[:, 0].mean() - sofa[:, 0].mean()) < 3
    assert len(chair) == pytest.approx(len(sofa), rel=0.1)
    # Looking east from the west the chair is in front, hence lower in the picture and larger.
    chair, sofa = (pixels_of(east, label) for label in (CHAIR, SOFA))
    assert chair[:, 0].mean() > sofa[:, 0].mean() + 30
    assert len(chair) > 1.3 * len(sofa)
    chair, sofa = (pixels_of(south, label) for label in (CHAIR, SOFA))
    assert chair[:, 1].min() > sofa[:, 1].max()
    # Nothing is cut off.
    for picture in (north, east, south):
        for label in (CHAIR, SOFA):
            places = pixels_of(picture, label)
            assert (places.min(axis=0) > 3).all()
            assert (places.max(axis=0) < np.array(SIZE) - 4).all()


def test_a_mesh_hides_the_box_behind_it(walk):
    # A screen of 4 x 4 m to the north of a small box without a mesh.
    room = objects((CHAIR, [0, 0, 0.2], [0.4] * 3), (SOFA, [0, 1.0, 2.0], [4, 4, 0.1]))
    screen = trimesh.creation.box(extents=(4, 0.1, 4))
    screen.apply_translation([0, 1.0, 2.0])
    north, south = turntable_frames(room, [None, screen], cameras=walk, num_frames=2)
    assert len(pixels_of(north, CHAIR)) > 50
    assert len(pixels_of(south, CHAIR)) == 0


def test_the_legend_counts_the_classes_in_their_colours(walk, monkeypatch):
    written = []
    draw = ImageDraw.ImageDraw.text
    monkeypatch.setattr(ImageDraw.ImageDraw, "text", lambda *a, **k: (written.append(a[2]), draw(*a, **k))[1])
    room = objects(*[(CHAIR, [x, 0, 0.4], [0.4] * 3) for x in (-1.0, 1.0)], (SOFA, [0, 0, 0.4], [0.4] * 3))
    (picture,) = turntable_frames(room, [None] * 3, cameras=walk, num_frames=1)
    assert sorted(written) == ["1 sofa", "2 chair"]
    strip = np.asarray(picture)[-LEGEND:]
    for label in (CHAIR, SOFA):
        assert (strip == PAPER_CLASSES.colors[label]).all(axis=-1).sum() > 40


def test_the_file_is_one_loop(tmp_path, walk):
    room = objects((CHAIR, [0, 0, 0.4], [0.8] * 3))
    path = draw_turntable(tmp_path / "turntable.gif", room, [ball([0, 0, 0.4])], cameras=walk, num_frames=3)
    with Image.open(path) as picture:
        assert (picture.format, picture.n_frames, picture.size) == ("GIF", 3, SIZE[::-1])
        assert picture.info["loop"] == 0
        picture.seek(2)
        assert len(pixels_of(picture.convert("RGB"), CHAIR)) > 1000
    again = draw_turntable(tmp_path / "again.gif", room, [ball([0, 0, 0.4])], cameras=walk, num_frames=3)
    assert again.read_bytes() == path.read_bytes()


def test_nothing_was_found(tmp_path, walk):
    path = draw_turntable(tmp_path / "turntable.gif", ObjectSet.empty(), [], cameras=walk, num_frames=2)
    with Image.open(path) as picture:
        # Not blank: the floor and the path are there.
        assert np.asarray(picture.convert("L")).min() < 240
