# SPDX-License-Identifier: Apache-2.0
"""Rendered views against photographs and answers that render nothing; PSNR and SSIM against scikit-image."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from raytran.errors import ShapeError
from raytran.geometry.camera import Cameras
from raytran.metrics import PSNR, SSIM, NewViewScores
from raytran.metrics.new_views import nearest_frames
from raytran.structs import Views

SHAPE = (2, 3, 3, 24, 32)


def cameras_at(*places: tuple[float, float, float], turned: tuple[float, ...] | None = None) -> torch.Tensor:
    """Poses of one scene, turned about z by some radians; they look along +y before that."""
    pose = torch.eye(4).repeat(1, len(places), 1, 1)
    for index, angle in enumerate(turned or (0.0,) * len(places)):
        cos, sin = math.cos(angle), math.sin(angle)
        turn = torch.tensor([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])
        pose[0, index, :3, :3] = turn @ torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    pose[0, :, :3, 3] = torch.tensor(places)
    return pose


def views_of(images: torch.Tensor, pose: torch.Tensor) -> Views:
    return Views(images, torch.eye(3).expand(*images.shape[:2], 3, 3), pose)


@pytest.fixture
def scene(generator) -> tuple[torch.Tensor, Views, Views]:
    """Two new views, the first beside the third of three frames and the second beside the first."""
    rendered = torch.rand(1, 2, 3, 16, 24, generator=generator)
    truth = torch.randint(0, 256, (1, 2, 3, 16, 24), generator=generator).to(torch.uint8)
    frames = torch.randint(0, 256, (1, 3, 3, 16, 24), generator=generator).to(torch.uint8)
    new = views_of(truth, cameras_at((2.1, 0, 0), (0, 0.1, 0)))
    seen = views_of(frames, cameras_at((0, 0, 0), (1, 0, 0), (2, 0, 0)))
    return rendered, new, seen


def test_each_column_by_hand(scene):
    rendered, new, seen = scene
    metric = NewViewScores()
    metric.update(rendered, new, seen, ["a"])
    found, truth = metric.compute(), new.images / 255
    psnr, ssim, nearest = PSNR(), SSIM(), PSNR()
    psnr.update(rendered, truth, ["a"])
    ssim.update(rendered, truth, ["a"])
    nearest.update(seen.images[:, [2, 0]] / 255, truth, ["a"])
    # The error of the mean colour is the variance, over the pixels of each channel.
    constant = (-10 * truth[0].var(dim=(2, 3), correction=0).mean(dim=1).log10()).mean()
    expected = {"psnr": psnr.compute(), "ssim": ssim.compute(), "psnr_nearest_frame": nearest.compute()}
    expected |= {"psnr_best_constant": constant, "n_views": 2}
    assert found == {name: pytest.approx(float(value), abs=1e-4) for name, value in expected.items()}
    rows = metric.rows()
    assert [(row["scene_id"], row["view"]) for row in rows] == [("a", 0), ("a", 1)]
    assert sum(row["psnr"] for row in rows) / 2 == pytest.approx(found["psnr"])


def test_no_constant_is_better_than_the_mean_colour(scene):
    _, new, seen = scene
    scores = []
    for shift in (0.0, -0.05, 0.05):
        metric = NewViewScores()
        mean = (new.images / 255).mean(dim=(3, 4), keepdim=True).expand(new.images.shape)
        metric.update(mean + shift, new, seen, ["a"])
        scores.append(metric.compute()["psnr"])
        assert metric.compute()["psnr_best_constant"] == pytest.approx(scores[0], abs=1e-4)
    assert scores[0] > max(scores[1:])


def test_a_scene_counts_once_and_none_is_no_number(scene):
    metric = NewViewScores()
    assert math.isnan(metric.compute()["psnr"])
    metric.update(*scene, ["a"])
    once = metric.compute()
    metric.update(*scene, ["a"])
    assert metric.compute() == once
    metric.update(*scene, ["b"])
    assert metric.compute()["n_views"] == 4


def test_the_nearest_frame_stands_and_looks_alike():
    def of(pose: torch.Tensor) -> Cameras:
        return Cameras(torch.eye(3).expand(*pose.shape[:2], 3, 3), pose, (4, 4))

    new = of(cameras_at((0, 0, 0)))
    # Half a metre away and looking the same way, or at the same place and turned by 0.6 radians.
    seen = of(cameras_at((0.5, 0, 0), (0, 0, 0), turned=(0.0, 0.6)))
    assert nearest_frames(new, seen).tolist() == [[0]]
    seen = of(cameras_at((0.5, 0, 0), (0, 0, 0), turned=(0.0, 0.4)))
    assert nearest_frames(new, seen).tolist() == [[1]]


def test_shapes_are_checked(scene):
    rendered, new, seen = scene
    with pytest.raises(ShapeError, match="as many rendered views"):
        NewViewScores().update(rendered[:, :1], new, seen, ["a"])
    with pytest.raises(ShapeError, match="2 names"):
        NewViewScores().update(rendered, new, seen, ["a", "b"])


@pytest.fixture
def images(generator) -> tuple[torch.Tensor, torch.Tensor]:
    rows = torch.linspace(0, 1, 24)[:, None].expand(SHAPE)
    target = (rows + 0.2 * torch.rand(SHAPE, generator=generator)) / 1.2
    noise = torch.linspace(0.01, 0.3, 6).reshape(2, 3, 1, 1, 1)  # so that frames differ much in quality
    return (target + noise * torch.randn(SHAPE, generator=generator)).clamp(0, 1), target


def frames(images) -> list[tuple[np.ndarray, np.ndarray]]:
    predicted, target = (side.flatten(0, 1).movedim(1, -1).double().numpy() for side in images)
    return list(zip(predicted, target, strict=True))


def test_psnr_is_the_mean_over_frames(images):
    metric = PSNR()
    metric.update(*images, ["a", "b"])
    expected = [peak_signal_noise_ratio(true, found, data_range=1.0) for found, true in frames(images)]
    assert metric.compute().item() == pytest.approx(np.mean(expected), abs=1e-4)
    metric.update(images[0][:1], images[1][:1], ["a"])  # a repeated scene changes nothing
    assert metric.compute().item() == pytest.approx(np.mean(expected), abs=1e-4)


def slow_ssim(true: np.ndarray, found: np.ndarray) -> float:
    """The mean over all pixels, images mirrored at the border (scikit-image leaves the border out)."""
    mirrored = (np.pad(image, ((5, 5), (5, 5), (0, 0)), mode="reflect") for image in (true, found))
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "full": True}
    return structural_similarity(*mirrored, data_range=1.0, channel_axis=-1, **settings)[1][5:-5, 5:-5].mean()


def test_ssim_is_the_mean_over_frames(images):
    metric = SSIM()
    metric.update(*images, ["a", "b"])
    expected = [slow_ssim(true, found) for found, true in frames(images)]
    assert metric.compute().item() == pytest.approx(np.mean(expected), abs=1e-4)
    one = SSIM()
    one.update(images[0][:1, :1], images[1][:1, :1], ["a"])
    assert one.compute().item() == pytest.approx(expected[0], abs=1e-4)


def test_equal_images_and_no_images():
    image = torch.rand(1, 1, 3, 16, 16)
    psnr, ssim = PSNR(), SSIM()
    for metric in (psnr, ssim):
        metric.update(image, image, ["a"])
    assert math.isinf(psnr.compute().item())
    assert ssim.compute().item() == pytest.approx(1.0)
    empty = PSNR()
    empty.update(torch.zeros(0, 1, 3, 16, 16), torch.zeros(0, 1, 3, 16, 16), [])
    assert math.isnan(empty.compute().item())


def test_shapes_of_images_are_checked():
    image = torch.rand(1, 1, 3, 16, 16)
    with pytest.raises(ShapeError, match="a name for each scene"):
        PSNR().update(image, image, ["a", "b"])
    with pytest.raises(ShapeError, match="B, N, 3, H, W"):
        SSIM().update(image[0], image[0], ["a"])
