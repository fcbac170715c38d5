# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import torch

from raytran.data.prepare.boxed_mesh import box_mesh
from raytran.data.prepare.boxed_objects import BoxedObjects, moved_mesh


def test_boxes_and_all_meshes_move_together() -> None:
    cube, in_room = box_mesh(), np.diag([2.0, 1.0, 1.0, 1.0])
    objects = BoxedObjects(
        named_in="boxes.json",
        category=("bench",),
        center=np.zeros((1, 3)),
        size=np.array([[2.0, 1.0, 1.0]]),
        rotation=np.eye(3)[None],
        symmetry=(1,),
        mesh=(moved_mesh(cube, in_room),),
        scan_mesh=moved_mesh(cube, in_room),
    )
    turn = torch.tensor([[0.0, -3, 0, 1], [3, 0, 0, 2], [0, 0, 3, 3], [0, 0, 0, 1]])
    moved = objects.moved(turn)
    np.testing.assert_allclose(moved.center, [[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(moved.size, [[6.0, 3.0, 3.0]])
    own, scan = moved.mesh[0], moved.scan_mesh
    assert own is not None
    assert scan is not None
    for vertices, _ in (own, scan):
        inside = (vertices - moved.center[0]) @ moved.rotation[0] / moved.size[0]
        np.testing.assert_allclose(np.abs(inside), 0.5)
    assert objects.moved(None) is objects
