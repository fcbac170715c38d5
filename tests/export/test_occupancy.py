# SPDX-License-Identifier: Apache-2.0
"""The cloud holds the centres of the likely voxels, in the world, and how likely each is."""

from __future__ import annotations

import numpy as np
import torch
import trimesh

from raytran.export.occupancy import write_occupancy


def test_points_lie_where_the_voxels_are(tmp_path):
    occupancy = torch.full((4, 4, 2), 0.5)
    occupancy[1, 2, 0], occupancy[0, 0, 1] = 0.75, 1.0
    path = write_occupancy(
        tmp_path / "o.ply", occupancy, center=torch.tensor([10.0, 0, 1]), extent=(4.0, 8.0, 2.0)
    )
    cloud = trimesh.load(path)
    # Voxels of 1 x 2 x 1 m from (8, -4, 0) on; z runs fastest.
    assert cloud.vertices.tolist() == [[8.5, -3.0, 1.5], [9.5, 1.0, 0.5]]
    # The last and the middle of viridis' 256 colours.
    assert cloud.colors[:, :3].tolist() == [[253, 231, 36], [32, 144, 140]]
    points = np.frombuffer(
        path.read_bytes().split(b"end_header\n")[1], dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3), ("p", "<f4")]
    )
    assert points["p"].tolist() == [1.0, 0.75]


def test_nothing_is_occupied(tmp_path):
    path = write_occupancy(
        tmp_path / "o.ply", torch.zeros(2, 2, 2), center=torch.zeros(3), extent=(1.0, 1.0, 1.0)
    )
    assert path.read_bytes().startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 0\n")
    assert path.read_bytes().endswith(b"end_header\n")
