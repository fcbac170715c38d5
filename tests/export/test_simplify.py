# SPDX-License-Identifier: Apache-2.0
"""Simplified meshes stay within the distance they promise, measured by other means than it is kept by."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from raytran.data.shapenet.voxelize import voxelize_solid
from raytran.errors import ConfigError
from raytran.export.simplify import simplify
from raytran.geometry.rotation import rotation_from_yaw
from raytran.postprocess import object_meshes
from raytran.rooms.cad import sample_model
from raytran.structs import ObjectSet, ScenePrediction


def surface(shape: torch.Tensor, size: tuple[float, float, float]) -> trimesh.Trimesh:
    """Marching cubes of a shape grid, 40 m away from the origin."""
    one = torch.ones(1, dtype=torch.int64)
    center, sides = torch.tensor([[40.0, -3.0, 1.0]]), torch.tensor([size])
    objects = ObjectSet(
        one, center, sides, rotation_from_yaw(torch.tensor([0.4])), one, one.float(), shape[None]
    )
    (mesh,) = object_meshes(ScenePrediction("a", objects, torch.zeros(3)))
    return mesh


def rough(cells: int = 24) -> torch.Tensor:
    """A ball with ripples of two cells, thin needles, and noise all around."""
    generator = torch.Generator().manual_seed(3)
    x, y, z = torch.meshgrid(*3 * [torch.linspace(-1, 1, cells)], indexing="ij")
    radius = (x**2 + y**2 + z**2).sqrt()
    ripple = 0.5 * (torch.arange(cells) % 2)[:, None, None]
    ball = torch.sigmoid(10 * (0.6 - radius) + ripple)
    ball[cells // 2, cells // 2, :] = 0.8
    return ball + 0.55 * (torch.rand(ball.shape, generator=generator) > 0.99)


def distances(points: np.ndarray, mesh: trimesh.Trimesh) -> np.ndarray:
    """Of each point from each triangle, the least."""
    least = np.full(len(points), np.inf)
    for triangle in np.asarray(mesh.triangles):
        on_it = trimesh.triangles.closest_point(np.broadcast_to(triangle, (len(points), 3, 3)), points)
        least = np.minimum(least, np.linalg.norm(on_it - points, axis=1))
    return least


@pytest.mark.parametrize("error", [0.01, 0.03])
def test_no_point_of_either_is_farther_from_the_other_than_allowed(error):
    mesh = surface(rough(), (1.2, 0.9, 0.7))
    small = simplify(mesh, error)
    assert len(small.faces) < len(mesh.faces) / 2
    assert distances(np.asarray(mesh.vertices), small).max() <= error + 1e-9
    points, _ = trimesh.sample.sample_surface(small, 3000, seed=1)
    assert distances(points, mesh).max() <= error + 1e-9


def test_whole_furniture_becomes_small_and_keeps_its_volume():
    chair = sample_model("chair", np.random.default_rng(3))
    shape = torch.from_numpy(voxelize_solid(chair.vertices, chair.faces, size=63)).float()
    mesh = surface(shape, tuple(chair.size_m.tolist()))
    small = simplify(mesh)
    assert len(small.faces) < len(mesh.faces) / 6
    assert small.volume == pytest.approx(mesh.volume, rel=0.05)
    np.testing.assert_allclose(small.bounds, mesh.bounds, atol=0.01)


def test_ripples_of_a_flat_side_are_smoothed():
    shape = torch.zeros(32, 32, 32)
    shape[:, 8:24] = 1.0
    shape[::2, 24] = 0.49
    shape[1::2, 24] = 0.3
    mesh = surface(shape, (1.0, 1.0, 1.0))

    def top_normals(of: trimesh.Trimesh) -> np.ndarray:
        # Of its flat top, by area; 1 is upright.
        up, weight = of.face_normals[:, 2], of.area_faces
        middle = of.triangles_center - (40.0, -3.0, 1.0)
        top = (middle[:, 2] > 0.2) & (np.abs(middle[:, :2]) < 0.25).all(axis=1)
        return np.average(up[top], weights=weight[top])

    assert top_normals(simplify(mesh, 0.02)) > max(0.995, top_normals(mesh))


def test_settings():
    mesh = trimesh.creation.box()
    assert simplify(mesh, 0) is mesh
    for error in (-0.1, float("nan"), 2.0):
        with pytest.raises(ConfigError, match="mesh_error"):
            simplify(mesh, error)
