# SPDX-License-Identifier: Apache-2.0
"""What no camera gives is named with its view; what one may give passes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from raytran.errors import DataError, RaytranError, ShapeError
from raytran.geometry.checks import check_views, rigid_motions
from raytran.structs import Views

from ..factories import make_views


def spoiled(name: str, change: Callable[[Tensor], object], dtype: torch.dtype | None = None) -> Views:
    """Return four views of which ``change`` spoils a tensor, in place or by what it returns."""
    views = replace(make_views(views=4), picture=torch.tensor([0.0, 0, 48, 32]).repeat(1, 4, 1))
    tensor = getattr(views, name).clone()
    tensor = tensor / 255 if dtype is not None else tensor
    changed = change(tensor)
    return replace(views, **{name: changed if isinstance(changed, Tensor) else tensor})


def put(*index: int | slice, value: float) -> Callable[[Tensor], None]:
    def change(tensor: Tensor) -> None:
        tensor[0, *index] = value

    return change


NAN, INF = float("nan"), float("inf")
MIRROR = torch.tensor([-1.0, 1, 1, 1])
IMPOSSIBLE = {
    "NaN pose": ("world_from_camera", put(2, 0, 3, value=NAN), "view 2 has a pose"),
    "infinite pose": ("world_from_camera", put(2, 0, 0, value=INF), "view 2 has a pose"),
    "scaled pose": ("world_from_camera", put(1, slice(3), slice(3), value=0.5), "view 1 has a pose"),
    "left-handed poses": ("world_from_camera", lambda t: t * MIRROR, r"view 0 \(and 3 more\) has a pose"),
    "no pose at all": ("world_from_camera", lambda t: t.zero_(), r"view 0 \(and 3 more\) has a pose"),
    "infinite focal length": ("intrinsics", put(3, 0, 0, value=INF), "view 3 has intrinsics that are not"),
    "NaN centre": ("intrinsics", put(3, 1, 2, value=NAN), "view 3 has intrinsics that are not"),
    "focal length of 0": ("intrinsics", put(0, 1, 1, value=0.0), "view 0 has intrinsics that are not"),
    "negative focal length": ("intrinsics", put(0, 0, 0, value=-40.0), "view 0 has intrinsics that are not"),
    "K of another scale": ("intrinsics", put(1, 2, 2, value=2.0), "view 1 has intrinsics without the last"),
    "K by columns": ("intrinsics", lambda t: t.mT, r"view 0 \(and 3 more\) has intrinsics without the last"),
    "centre elsewhere": ("intrinsics", put(1, 0, 2, value=500.0), "view 1 has a principal point far outside"),
    "empty picture": ("picture", put(1, 0, value=48.0), "view 1 has a picture that is empty"),
    "picture that leaves": ("picture", put(1, 3, value=33.0), "view 1 has a picture that is empty or leaves"),
    "NaN picture": ("picture", put(1, 3, value=NAN), "view 1 has a picture"),
}


@pytest.mark.parametrize("case", IMPOSSIBLE)
def test_what_no_camera_gives_is_named_with_its_view(case):
    name, change, message = IMPOSSIBLE[case]
    views = spoiled(name, change)
    with pytest.raises(DataError, match=f"^{message}.*: give ") as found:
        check_views(views)
    assert len(str(found.value)) <= 300
    check_views(views, values=False)


@pytest.mark.parametrize("value", [NAN, INF, -INF, -0.2, 1.5, 255.0])
def test_colours_that_are_none(value):
    views = spoiled("images", put(1, 2, 5, 7, value=value), torch.float32)
    with pytest.raises(DataError, match="view 1 has colours that are no numbers from 0 to 1: divide by 255"):
        check_views(views)
    check_views(views, values=False)


TYPES_AND_SHAPES = {
    "images of integers": ("images", lambda t: t.long(), "images are of type torch.int64: give uint8"),
    "images of booleans": ("images", lambda t: t > 3, "images are of type torch.bool"),
    "poses of integers": ("world_from_camera", lambda t: t.long(), "world_from_camera are of type"),
    "intrinsics of integers": ("intrinsics", lambda t: t.long(), "intrinsics are of type torch.int64"),
    "poses elsewhere": ("world_from_camera", lambda t: t.to("meta"), "are on meta and images on cpu"),
    "no batch": ("images", lambda t: t[0], "images of shape"),
    "two scenes": ("images", lambda t: t.expand(2, *t.shape[1:]), "images of shape"),
    "channels last": ("images", lambda t: t.permute(0, 1, 3, 4, 2), "images of shape"),
    "a mask too many": ("images", lambda t: torch.cat([t, t[:, :, :1]], dim=2), "images of shape"),
    "a pose too few": ("world_from_camera", lambda t: t[:, 1:], r"world_from_camera of shape \(1, 4, 4, 4\)"),
    "poses 3x4": ("world_from_camera", lambda t: t[..., :3, :], "world_from_camera of shape"),
    "one K for all": ("intrinsics", lambda t: t[:, 0], "intrinsics of shape"),
    "K 4x4": ("intrinsics", lambda t: torch.zeros(1, 4, 4, 4), "intrinsics of shape"),
    "no views": ("images", lambda t: t[:, :0], "images of shape"),
    "one picture for all": ("picture", lambda t: t[0, 0], "picture of shape"),
}


@pytest.mark.parametrize("case", TYPES_AND_SHAPES)
@pytest.mark.parametrize("values", [True, False])
def test_types_and_shapes_are_always_checked(case, values):
    name, change, message = TYPES_AND_SHAPES[case]
    with pytest.raises(RaytranError, match=message) as found:
        check_views(spoiled(name, change), values=values)
    assert isinstance(found.value, ShapeError) == ("shape" in message)


def test_what_cameras_give_passes():
    views = make_views(views=4)
    for good in (
        views,
        replace(views, images=views.images / 255),
        replace(views, images=(views.images / 255).half()),
        replace(
            views, intrinsics=views.intrinsics.double(), world_from_camera=views.world_from_camera.double()
        ),
        # A crop from beside the middle; seven digits in a file.
        replace(views, intrinsics=views.intrinsics + torch.tensor([[0.0, 0, -40], [0, 0, 20], [0, 0, 0]])),
        replace(views, world_from_camera=views.world_from_camera + 1e-4),
        replace(views, picture=torch.tensor([12.5, 0, 36, 32]).expand(1, 4, 4)),
    ):
        check_views(good)
    check_views(make_views(channels=4), channels=4)


def test_rigid_motions():
    pose = torch.eye(4).repeat(2, 3, 1, 1)
    pose[0, 1, 1, 1] = -1
    pose[1, 2, 0, 3] = INF
    pose[1, 0, :3, :3] *= 1.02
    assert rigid_motions(pose).tolist() == [[True, False, True], [False, True, False]]
    assert rigid_motions(pose[:0]).shape == (0, 3)
