# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import torch
import trimesh

from raytran.data.prepare.boxed_mesh import box_mesh, cut_to_box, share_in_box
from raytran.data.shapenet.voxelize import voxelize_solid
from raytran.geometry.rotation import rotation_from_yaw

TABLE = np.array([1.0, 0.7, 0.6])
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def mesh_of(*parts):
    joined = trimesh.util.concatenate(parts)
    return np.asarray(joined.vertices), np.asarray(joined.faces)


def part(extents, center):
    mesh = trimesh.creation.box(extents)
    mesh.apply_translation(center)
    return mesh


FLOOR = part((6, 6, 0.002), (0, 0, 0))
TOP = part((1.0, 0.6, 0.04), (0.5, 0.2, 0.68))


def cut(mesh, size=TABLE, center=(0.5, 0.2, 0.35), rotation=UPRIGHT, **options):
    return cut_to_box(mesh, center=np.array(center), size=size, rotation=rotation, **options)


def test_what_stands_in_the_box_is_cut_out_in_its_frame():
    vertices, faces = cut(mesh_of(FLOOR, TOP, part((1, 1, 1), (2, 2, 0.5))))
    assert np.abs(vertices).max() <= 0.5
    # The top lies in the upper twentieth of the box; y is the object's up.
    assert vertices[:, 1].min() > 0.4
    assert vertices[:, 1].max() == 0.5
    np.testing.assert_allclose(np.ptp(vertices[:, [0, 2]], axis=0), 1)
    cells = voxelize_solid(vertices, faces, box=(-0.5, 0.5))
    assert cells.any(axis=(0, 2)).nonzero()[0].min() > 55


def test_the_floor_stays_where_it_is_asked_for():
    vertices, _ = cut(mesh_of(FLOOR, TOP), on_floor=False)
    assert vertices[:, 1].min() == -0.5


def test_what_is_a_little_outside_is_taken_for_the_side_of_the_box():
    higher = mesh_of(part((1.0, 0.6, 0.002), (0.5, 0.2, 0.715)))
    vertices, _ = cut(higher)
    assert set(vertices[:, 1].tolist()) == {0.5}
    assert cut(mesh_of(part((1.0, 0.6, 0.002), (0.5, 0.2, 0.75)))) is None


def test_large_triangles_are_cut_at_the_sides():
    wall = np.array([[-9.0, 0.2, -9], [9, 0.2, -9], [0, 0.2, 20]]), np.array([[0, 1, 2]])
    vertices, faces = cut(wall)
    np.testing.assert_allclose(
        [vertices.min(axis=0), vertices.max(axis=0)], [[-0.5, -0.5, 0], [0.5, 0.5, 0]], atol=1e-9
    )
    assert len(faces) >= 2


def test_a_turned_box_cuts_as_one_that_is_not():
    yaw = np.deg2rad(37)
    rotation = rotation_from_yaw(torch.tensor(yaw, dtype=torch.float64)).numpy()
    turn = rotation @ UPRIGHT.T
    vertices, faces = mesh_of(FLOOR, TOP)
    turned = cut((vertices @ turn.T, faces), rotation=rotation, center=turn @ np.array([0.5, 0.2, 0.35]))
    plain = cut((vertices, faces))
    a, b = (voxelize_solid(*mesh, box=(-0.5, 0.5)) for mesh in (turned, plain))
    assert (a != b).mean() < 0.01


def test_too_little_tells_no_shape():
    assert cut(mesh_of(FLOOR)) is None
    assert cut(mesh_of(part((0.1, 0.1, 0.1), (0.5, 0.2, 0.5)))) is None
    assert cut(mesh_of(part((1, 1, 1), (5, 5, 0.5)))) is None


def test_the_share_of_a_mesh_in_a_box():
    mesh = mesh_of(TOP, part((1, 0.5, 0.5), (3, 0, 0)))
    share = share_in_box(mesh, center=np.array([0.5, 0.2, 0.35]), size=TABLE, rotation=UPRIGHT)
    assert share == 0.5


def test_the_box_itself_is_solid():
    vertices, faces = box_mesh()
    assert trimesh.Trimesh(vertices, faces, process=False).volume > 0.999
    assert voxelize_solid(vertices, faces, box=(-0.5, 0.5)).all()
