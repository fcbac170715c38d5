# SPDX-License-Identifier: Apache-2.0
"""What the shape head reads in a predicted box."""

from __future__ import annotations

import math

import torch

from raytran.export.torch_program import example_inputs, export_network, export_shapes
from raytran.extensions.box_voxels import CELLS, BoxVoxelShapeHead, box_points, read_voxels
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.structs import RawObjects

from ..factories import CHANNELS, make_model, make_views


def _objects(center: torch.Tensor, size: torch.Tensor, yaw: torch.Tensor, channels: int = 3) -> RawObjects:
    return RawObjects(
        class_logits=torch.zeros(*yaw.shape, 10),
        center=center,
        log_size=size.log(),
        yaw_vector=2 * torch.stack([yaw.sin(), yaw.cos()], dim=-1),
        embedding=torch.randn(*yaw.shape, channels),
    )


def test_places_are_those_of_the_cells_of_the_turned_box() -> None:
    center, size, yaw = torch.tensor([1.0, 2.0, 0.5]), torch.tensor([0.8, 0.4, 2.0]), math.radians(30)
    points = box_points(_objects(center[None, None], size[None, None], torch.tensor([[yaw]])), 4)[0, 0]
    # The object's x lies along (cos, sin, 0), its y is up, its z along (sin, -cos, 0).
    for number, (i, j, k) in enumerate((i, j, k) for i in range(4) for j in range(4) for k in range(4)):
        along = [side * ((n + 0.5) / 4 - 0.5) for side, n in zip(size.tolist(), (i, j, k), strict=True)]
        x = 1.0 + along[0] * math.cos(yaw) + along[2] * math.sin(yaw)
        y = 2.0 + along[0] * math.sin(yaw) - along[2] * math.cos(yaw)
        torch.testing.assert_close(points[number], torch.tensor([x, y, 0.5 + along[1]]))


def test_features_that_are_positions_are_read_as_positions_and_outside_is_zero() -> None:
    grid = VoxelGrid((8, 9, 6), (4.0, 4.5, 3.0), torch.tensor([[1.0, 2.0, 1.5], [0.0, 0.0, 0.0]]))
    voxels = grid.voxel_centers()
    points = grid.center[:, None] + torch.rand(2, 50, 3) * 2 - 1
    torch.testing.assert_close(read_voxels(voxels, grid, points), points)
    assert not read_voxels(voxels, grid, grid.center[:, None] + 5.0).any()


def test_a_head_reads_query_and_box_of_its_own_object_without_gradient() -> None:
    torch.manual_seed(0)
    grid = VoxelGrid((8, 8, 8), (4.0, 4.0, 4.0), torch.zeros(1, 3))
    head = BoxVoxelShapeHead(channels=3, widths=(8, 8, 4, 4))
    place = torch.tensor([[[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]])
    objects = _objects(place, torch.full((1, 2, 3), 0.6), torch.zeros(1, 2))
    voxels = torch.randn(1, 8, 8, 8, 3, requires_grad=True)

    def decoded(voxels: torch.Tensor, objects: RawObjects = objects) -> torch.Tensor:
        read = head.with_box_voxels(objects, voxels, grid)
        assert read.embedding.shape == (1, 2, head.in_channels)
        assert not read.embedding.requires_grad
        return head(read.embedding[0])

    before = decoded(voxels)
    assert before.shape == (2, 63, 63, 63)
    changed = voxels.detach().clone()
    changed[:, 4:] += 1.0
    after = decoded(changed)
    assert torch.equal(after[0], before[0])
    assert not torch.equal(after[1], before[1])
    before.sum().backward()
    assert all(p.grad is not None for p in head.parameters())


def test_its_programs_go_together() -> None:
    model = make_model().eval()
    model.heads["shape"] = BoxVoxelShapeHead(channels=CHANNELS, widths=(8, 8, 4, 4)).eval()
    cameras = Cameras.of(make_views(views=3).scene())
    inputs = example_inputs(model, cameras)
    outputs = export_network(model, cameras, tasks=("objects",)).module()(*inputs)
    decoded = export_shapes(model).module()(outputs["embedding"])
    torch.testing.assert_close(decoded, model.decode_shapes(outputs["embedding"]), atol=1e-4, rtol=1e-4)
    assert decoded.shape == (5, 63, 63, 63)


def test_the_network_decodes_shapes_from_boxes_in_every_pass() -> None:
    model = make_model()
    model.heads["shape"] = BoxVoxelShapeHead(channels=CHANNELS, widths=(8, 8, 4, 4))
    raw = model.eval()(make_views())
    assert {layer.embedding.shape[-1] for layer in raw.objects or ()} == {CHANNELS * (1 + CELLS**3)}
    found = model.predict(make_views()).objects
    assert found.shape is not None
    expected = model.heads["shape"](raw.objects[-1].embedding[0]).sigmoid()
    order = raw.objects[-1].class_logits[0].softmax(-1)[:, :-1].amax(-1).argsort(descending=True, stable=True)
    torch.testing.assert_close(found.shape, expected[order], atol=1e-4, rtol=1e-4)
