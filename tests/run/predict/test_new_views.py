# SPDX-License-Identifier: Apache-2.0
"""FrameImages of new cameras: which volume renders them, their size, and what is refused."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from torch import nn

from raytran.capture.lens import Lens
from raytran.capture.render_cameras import RenderCameras
from raytran.errors import ConfigError, DataError
from raytran.geometry.room_tiles import Volumes
from raytran.run.predict.new_views import cameras_to_render, render_views
from raytran.run.predict.room import RoomViews
from raytran.structs import Views

SIZE = (32, 48)
AHEAD = torch.tensor([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


class Painter(nn.Module):
    """Renders images as grey as their volume's x coordinate in tenths, two cameras at a time."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(1))
        self.heads = {"view": self}
        self.calls: list[tuple[int, int]] = []

    def render(self, views, cameras, *, views_at_once, grid_center):
        count = cameras.intrinsics.shape[1]
        self.calls.append((views.images.shape[1], count))
        assert cameras.image_size == SIZE
        for start in range(0, count, 2):
            yield (grid_center[0] / 10).expand(min(2, count - start), 3, *SIZE)


def room(*centers: float) -> RoomViews:
    """Volumes along x, three frames in each."""
    count = 3 * len(centers)
    pose = AHEAD.expand(1, count, 4, 4)
    views = Views(
        torch.zeros(1, count, 3, *SIZE, dtype=torch.uint8), torch.eye(3).expand(1, count, 3, 3), pose
    )
    center = torch.tensor([[x, 0.0, 0.0] for x in centers], dtype=torch.float64)
    members = tuple(tuple(range(3 * i, 3 * i + 3)) for i in range(len(centers)))
    return RoomViews(views, tuple(map(str, range(count))), Volumes((8, 8, 4), (4, 4, 2), center), members)


def cameras_at(*places: float, size: tuple[int, int] = (60, 80)) -> RenderCameras:
    poses = AHEAD.double().repeat(len(places), 1, 1)
    poses[:, 0, 3] = torch.tensor(places)
    lens = Lens(size, (70.0, 70.0), (40.0, 30.0))
    return RenderCameras(tuple(f"at {x:g}" for x in places), (lens,) * len(places), poses)


def test_each_camera_is_rendered_from_the_volume_ahead_of_it(tmp_path, caplog):
    model, wanted = Painter(), cameras_at(4.6, 1.9, 2.2, 5.0, 1.0)
    folder = render_views(model, room(2.0, 5.0), wanted, tmp_path)
    assert model.calls == [(3, 3), (3, 2)]
    grey = {path.stem: np.unique(np.asarray(Image.open(path))).tolist() for path in folder.iterdir()}
    assert grey == {"at 1.9": [51], "at 2.2": [51], "at 1": [51], "at 4.6": [128], "at 5": [128]}
    assert [path.name for path in tmp_path.iterdir()] == ["new_views"]
    assert "outside" not in caplog.text


def test_pictures_have_the_size_of_their_cameras(tmp_path, caplog):
    folder = render_views(Painter(), room(2.0), cameras_at(2.0, size=(90, 200)), tmp_path)
    assert Image.open(folder / "at 2.png").size == (200, 90)
    render_views(Painter(), room(2.0), cameras_at(30.0, 2.0), tmp_path / "b")
    assert "1 of 2 new cameras stand outside of the volume" in caplog.text


def test_a_rendering_that_fails_leaves_nothing(tmp_path):
    model = Painter()
    model.render = lambda *_, **__: (_fail() for _ in range(1))
    with pytest.raises(MemoryError):
        render_views(model, room(2.0), cameras_at(2.0), tmp_path)
    assert list(tmp_path.iterdir()) == []


def _fail():
    raise MemoryError


def test_a_network_that_cannot_render_is_refused_before_anything_is_done(tmp_path):
    blind = SimpleNamespace(heads={"objects": None})
    assert cameras_to_render(None, blind, "a.ckpt") is None
    with pytest.raises(ConfigError, match=r"a\.ckpt cannot render views=.*experiment=novel_view"):
        cameras_to_render(str(tmp_path / "none.json"), blind, "a.ckpt")
    with pytest.raises(DataError, match="check the path"):
        cameras_to_render(str(tmp_path / "none.json"), Painter(), "a.ckpt")
