# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
import torch

from raytran.geometry.camera import Cameras, pose_from_heading
from raytran.rooms.materials import Paint, Surfaces, box_triangles, quad_triangles
from raytran.rooms.render import Pinhole, Renderer
from raytran.rooms.room import Light

GREY = Paint(dark=(0.5, 0.5, 0.5), light=(0.5, 0.5, 0.5))
RED = Paint(dark=(1.0, 0.0, 0.0), light=(1.0, 0.0, 0.0))
WIDE = np.array([[-4.0, -4, 0], [4, -4, 0], [4, 4, 0], [-4, 4, 0]])
NO_NOISE = np.zeros((48, 64, 3), dtype=np.float32)


def lamp(position, *, shadows=True, half_side=0.0):
    return Light(np.array(position), np.array([0.0, 0.0, -1.0]), np.ones(3), half_side, shadows)


def camera(eye, down=np.pi / 2 - 1e-9, heading=np.pi / 2):
    matrix = np.array([[60.0, 0, 31.3], [0, 60.0, 24.6], [0, 0, 1]])
    return Pinhole(matrix, pose_from_heading(np.array(eye), heading, down, 0.0), (48, 64))


def floor_with(*parts):
    return Surfaces.joined([Surfaces.painted(quad_triangles(WIDE), GREY), *parts])


def test_a_marker_appears_where_the_camera_model_projects_it():
    """Against ``Cameras.project``, which knows nothing of the renderer."""
    view = camera((0.4, -1.5, 1.5), down=0.7)
    spots = np.array([[0.3, 0.2, 0.0], [-0.6, 0.8, 0.0], [0.9, 0.6, 0.0]])
    markers = [Surfaces.painted(box_triangles(s - 0.04, s + 0.04), RED, owner=i) for i, s in enumerate(spots)]
    owner = Renderer(surfaces=floor_with(*markers), lights=[]).owners(view, 1).reshape(48, 64)
    model = Cameras(torch.from_numpy(view.intrinsics), torch.from_numpy(view.room_from_camera), (48, 64))
    pixels = model.project(torch.from_numpy(spots))[0].numpy()
    for i in range(3):
        row, column = np.nonzero(owner == i)
        np.testing.assert_allclose([column.mean() + 0.5, row.mean() + 0.5], pixels[i], atol=0.6)


def test_same_input_same_bytes_and_noise_is_added():
    renderer = Renderer(surfaces=floor_with(), lights=[lamp((0.0, 0.0, 2.5))])
    first = renderer.render(camera((0, 0, 2)), NO_NOISE)
    np.testing.assert_array_equal(first, renderer.render(camera((0, 0, 2)), NO_NOISE))
    brighter = renderer.render(camera((0, 0, 2)), NO_NOISE + 5)
    np.testing.assert_array_equal(brighter.astype(int) - first, 5)


def test_an_object_throws_a_shadow():
    plate = Surfaces.painted(box_triangles([-0.4, -0.4, 1.0], [0.4, 0.4, 1.02]), GREY, owner=0)
    view = camera((1.5, 0.0, 1.5), down=0.8, heading=np.pi)
    with_plate = Renderer(surfaces=floor_with(plate), lights=[lamp((0, 0, 2.5))])
    without = Renderer(surfaces=floor_with(), lights=[lamp((0, 0, 2.5))])
    dark, bright = (renderer.render(view, NO_NOISE).astype(int) for renderer in (with_plate, without))
    rows, columns = np.meshgrid(np.arange(48) + 0.5, np.arange(64) + 0.5, indexing="ij")
    rays = view.directions(columns.ravel().astype(np.float32), rows.ravel().astype(np.float32))
    ground = view.room_from_camera[:3, 3] - rays * (1.5 / rays[:, 2:])
    seen = with_plate.owners(view, 1) < 0
    # The plate at 1 m, lit from 2.5 m, shades a square 2.5 / 1.5 times as large.
    reach = np.abs(ground[:, :2]).max(axis=1) / (0.4 * 2.5 / 1.5)
    in_shadow, in_light = (seen & (reach < 0.9)).reshape(48, 64), (seen & (reach > 1.1)).reshape(48, 64)
    assert in_shadow.sum() > 20
    assert (dark[in_shadow] < bright[in_shadow] - 20).all()
    assert (np.abs(dark[in_light] - bright[in_light]) <= 1).mean() > 0.97


def test_light_falls_off_with_distance():
    renderer = Renderer(surfaces=floor_with(), lights=[lamp((0, 0, 2.5), shadows=False)])
    row = renderer.render(camera((0, 0, 2)), NO_NOISE)[24, :, 0].astype(int)
    assert row[31] > row[5]
    assert row[31] > row[60]


def test_edges_are_mixed():
    """Along a slanted edge between dark and bright there are values in between."""
    corner = np.array([[-4.0, -4.0, 0.01], [4.0, -4.0, 0.01], [4.0, 0.7, 0.01], [-4.0, -0.9, 0.01]])
    top = Surfaces.painted(quad_triangles(corner), Paint((1.0, 1, 1), (1.0, 1, 1)), owner=0)
    picture = Renderer(surfaces=floor_with(top), lights=[]).render(camera((0, 0, 2)), NO_NOISE)[..., 0]
    levels = np.unique(picture)
    assert 4 <= len(levels) <= 5, levels
    assert ((picture > levels[0]) & (picture < levels[-1])).sum() > 30


def test_exposure_sets_the_mean_brightness():
    renderer = Renderer(surfaces=floor_with(), lights=[lamp((0, 0, 2.5))])
    view = camera((0, 0, 2))
    means = []
    for brightness in (0.1, 0.3):
        renderer.expose([view], brightness)
        means.append(renderer.render(view, NO_NOISE).mean() / 255)
    assert means[0] == pytest.approx(np.sqrt(0.1 / 1.09), abs=0.04)
    assert means[0] < means[1] - 0.1
