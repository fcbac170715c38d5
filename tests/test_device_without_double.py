# SPDX-License-Identifier: Apache-2.0
"""A GPU like Apple's, which has neither float64 nor products of sparse matrices, on the pretend device."""

from __future__ import annotations

from unittest.mock import patch

import pytest
import torch

import raytran
from raytran.geometry import double
from raytran.ops.traverse import RayTracer
from raytran.run.plan.camera_paths import walk
from raytran.structs import Views

from . import pretend_device
from .pretend_device import DEVICE, NAME, on_pretend_device


def like_apples(run):
    """Return ``_run`` of the pretend device as of a device that lacks what Apple's GPUs lack."""

    def refuse(func, args, kwargs):
        if func.namespace == "raytran":
            raise TypeError(f"{func}: no products of sparse matrices here")
        found = run(func, args, kwargs)
        for value in found if isinstance(found, tuple | list) else [found]:
            if isinstance(value, torch.Tensor) and value.device.type == NAME and value.dtype == torch.float64:
                raise TypeError(f"{func}: no float64 here")
        return found

    return refuse


def a_walk():
    cameras = walk(4).scaled_to((48, 64))
    images = torch.rand(1, 4, 3, 48, 64, generator=torch.Generator().manual_seed(0))
    return Views(images, cameras.intrinsics[None].float(), cameras.world_from_camera[None].float())


@on_pretend_device
def test_predictions_are_those_of_the_cpu():
    model, views = raytran.load(), a_walk()
    model.ray_tracer = RayTracer("sparse")  # the pretend device has kernels, which Apple's have not
    expected = model.predict(views, score_threshold=0.0, views_at_once=2)
    lacking = patch.object(pretend_device, "_run", like_apples(pretend_device._run))
    with lacking, patch.object(double, "WITHOUT_DOUBLE", {NAME}):
        found = model.to(DEVICE).predict(views.to(DEVICE), score_threshold=0.0, views_at_once=2)
        found = found.to("cpu")
    for name in ("center", "size", "score"):
        torch.testing.assert_close(getattr(found.objects, name), getattr(expected.objects, name))
    torch.testing.assert_close(found.occupancy, expected.occupancy)
    assert torch.equal(found.seen, expected.seen)


@on_pretend_device
def test_gradients_go_there_and_back():
    model = raytran.load().train()
    model.ray_tracer = RayTracer("sparse")
    views = a_walk()
    lacking = patch.object(pretend_device, "_run", like_apples(pretend_device._run))
    with lacking, patch.object(double, "WITHOUT_DOUBLE", {NAME}):
        raw = model.to(DEVICE)(views.to(DEVICE), tasks=("occupancy",))
        raw.occupancy.square().mean().backward()
    blocks = [
        value for name, value in model.named_parameters() if ".blocks." in name and value.grad is not None
    ]
    assert blocks
    assert all(value.grad.device.type == NAME for value in blocks)


@on_pretend_device
def test_the_check_sees_what_such_a_device_refuses():
    lacking = patch.object(pretend_device, "_run", like_apples(pretend_device._run))
    with lacking, pytest.raises(TypeError, match="no float64 here"):
        torch.ones(2, device=DEVICE).double()
    with lacking, pytest.raises(TypeError, match=r"no float64|no products of sparse"):
        raytran.load().to(DEVICE).predict(a_walk().to(DEVICE))
