# SPDX-License-Identifier: Apache-2.0
"""Masks, object numbers and depths against shapes whose picture is known by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from raytran.errors import ShapeError
from raytran.geometry.camera import Cameras
from raytran.geometry.rasterize import rasterize_ids, rasterize_mask

SQUARE_FACES = [[0, 1, 2], [0, 2, 3]]


def camera(image_size=(8, 8), focal=8.0, position=(0.0, 0.0, 0.0)) -> Cameras:
    """One camera at ``position`` that looks along the world's +z."""
    height, width = image_size
    intrinsics = torch.tensor([[[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]]])
    world_from_camera = torch.eye(4)[None].clone()
    world_from_camera[0, :3, 3] = torch.tensor(position)
    return Cameras(intrinsics, world_from_camera, image_size)


def square(left, top, right, bottom, z):
    """A square that faces the camera at depth ``z``, given by its corners in pixels of ``camera()``."""
    corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom]], dtype=float)
    return np.column_stack([(corners - 4) / 8 * z, np.full(4, z)]), np.array(SQUARE_FACES)


def cube(center, side):
    low, high = np.array(center) - side / 2, np.array(center) + side / 2
    vertices = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), -1).reshape(8, 3)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return vertices, np.array([[q[0], q[i], q[i + 1]] for q in quads for i in (1, 2)])


def test_pixels_whose_centre_is_covered_are_set() -> None:
    mask = rasterize_mask([square(1.6, 2.4, 5.6, 4.4, z=2.0)], camera())
    expected = torch.zeros(1, 8, 8, dtype=torch.bool)
    # Centres at 2.5 … 5.5 are right of 1.6 and left of 5.6; centres 2.5 and 3.5 lie between 2.4 and 4.4.
    expected[0, 2:4, 2:6] = True
    assert torch.equal(mask, expected)


def test_mask_ignores_what_is_in_front() -> None:
    near, far = square(0, 0, 4, 4, z=1.0), square(2, 2, 6, 6, z=3.0)
    expected = torch.zeros(8, 8, dtype=torch.bool)
    expected[0:4, 0:4] = True
    expected[2:6, 2:6] = True
    assert torch.equal(rasterize_mask([near, far], camera())[0], expected)


def test_ids_and_depth_are_those_of_the_nearest() -> None:
    ids, depth = rasterize_ids([square(2, 2, 6, 6, z=3.0), square(0, 0, 4, 4, z=1.0)], camera())
    expected = torch.full((8, 8), -1)
    expected[2:6, 2:6] = 0
    expected[0:4, 0:4] = 1
    assert torch.equal(ids[0], expected)
    torch.testing.assert_close(depth[0][expected == 0], torch.full((12,), 3.0))
    torch.testing.assert_close(depth[0][expected == 1], torch.full((16,), 1.0))
    assert torch.isinf(depth[0][expected == -1]).all()


def test_camera_inside_a_mesh_sees_it_everywhere() -> None:
    assert rasterize_mask([cube((0, 0, 0), 2.0)], camera()).all()


def test_mesh_that_reaches_behind_the_camera() -> None:
    # A floor 1 m below, from 5 m behind to 5 m ahead: the ray of row r meets it at depth 8 / (r - 3.5),
    # which is within 5 m from row 5.1 on, hence 5.6 counted from the centre of the image.
    floor = np.array([[-9.0, 1, -5], [9, 1, -5], [9, 1, 5], [-9, 1, 5]])
    mask = rasterize_mask([(floor, SQUARE_FACES)], camera())[0]
    assert mask[6:].all()
    assert not mask[:5].any()
    # Row 5: centre 1.5 below the principal point, depth 8 / 1.5 = 5.33 m, beyond the end of the floor.
    assert not mask[5].any()


def test_mesh_behind_the_camera_is_not_seen() -> None:
    assert not rasterize_mask([cube((0, 0, -3), 1.0)], camera()).any()


def test_one_mask_per_camera_and_no_culling_error() -> None:
    """Casting only inside projected boxes must give what casting every ray gives."""
    generator = torch.Generator().manual_seed(3)
    axis, _ = torch.linalg.qr(torch.randn(24, 3, 3, generator=generator, dtype=torch.float64))
    poses = torch.eye(4, dtype=torch.float64).repeat(24, 1, 1)
    poses[:, :3, :3] = axis * torch.linalg.det(axis)[:, None, None]
    poses[:, :3, 3] = torch.randn(24, 3, generator=generator, dtype=torch.float64)
    one = camera((30, 40), focal=30.0)
    cameras = Cameras(one.intrinsics.double().expand(24, 3, 3), poses, (30, 40))
    meshes = [cube(center, 0.7) for center in ((0.5, 0, 0.3), (-1, 1, 0), (0, -1, 1.5))]
    mask = rasterize_mask(meshes, cameras)
    origin, directions = cameras.cell_rays((30, 40))
    expected = torch.zeros_like(mask)
    for center in ((0.5, 0, 0.3), (-1, 1, 0), (0, -1, 1.5)):
        middle = torch.tensor(center, dtype=torch.float64)
        slabs = torch.stack([(middle + sign * 0.35 - origin) / directions for sign in (-1, 1)])
        enter, leave = slabs.amin(0).amax(-1), slabs.amax(0).amin(-1)
        expected |= ((leave >= enter) & (leave > 0)).squeeze(-1)
    assert mask.any(dim=(1, 2)).sum() >= 5
    assert (mask != expected).sum() <= 2  # Rays along an edge may go either way.


def test_no_mesh_gives_nothing() -> None:
    empty = (np.zeros((0, 3)), np.zeros((0, 3), dtype=int))
    assert not rasterize_mask([], camera()).any()
    ids, depth = rasterize_ids([empty, square(0, 0, 8, 8, z=1.0)], camera())
    assert (ids == 1).all()
    assert torch.isfinite(depth).all()


def test_camera_without_leading_dimension_is_an_error() -> None:
    one = camera()
    with pytest.raises(ShapeError, match="intrinsics"):
        rasterize_mask([], Cameras(one.intrinsics[0], one.world_from_camera[0], one.image_size))


def test_nothing_is_drawn_outside_of_the_picture() -> None:
    mesh, picture = square(0, 0, 8, 8, z=2.0), torch.tensor([[2.0, 0.0, 5.0, 8.0]])
    inside = replace(camera(), picture=picture)
    assert rasterize_mask([mesh], inside)[0].nonzero()[:, 1].unique().tolist() == [2, 3, 4]
    ids, depths = rasterize_ids([mesh], inside)
    assert ((ids == 0) == rasterize_mask([mesh], inside)).all()
    assert depths.isinf().equal(ids < 0)
