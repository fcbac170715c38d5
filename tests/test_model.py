# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from raytran.errors import ConfigError, DataError, ShapeError
from raytran.extensions.denoising import DenoisingLoss
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.geometry.rotation import yaw_from_rotation
from raytran.heads.score_scaling import ScoreScaling
from raytran.losses.matcher import HungarianMatcher
from raytran.losses.total import TotalLoss
from raytran.model import TASKS
from raytran.structs import RawObjects, RawScene, SceneBatch, Views

from .factories import CHANNELS, RESOLUTION, WEIGHTS, make_model, make_objects, make_views


def test_shapes() -> None:
    raw = make_model()(make_views(scenes=2, views=3))
    assert raw.occupancy.shape == (2, 6, 6, 4)
    assert raw.foreground.shape == (2, 3, 32, 48)
    assert len(raw.objects) == 2
    assert raw.objects[-1].center.shape == (2, 5, 3)


def test_only_what_was_asked_for() -> None:
    raw = make_model()(make_views(), tasks=("occupancy",))
    assert raw.occupancy is not None
    assert raw.foreground is None
    assert raw.objects is None


def test_copies_of_the_truth_are_corrected_in_training_alone() -> None:
    model, views, known = make_model(num_copies=4).train(), make_views(), (make_objects(3),)
    raw = model(views, tasks=("objects",), true_objects=known)
    assert [layer.center.shape for layer in raw.denoising] == [(1, 4, 3)] * 2
    batch = SceneBatch(("a",), views, ((),), raw.grid_center, objects=known)
    loss = TotalLoss(
        weights=WEIGHTS,
        matcher=HungarianMatcher(weights=WEIGHTS),
        extensions={"denoising": DenoisingLoss()},
    )
    losses = loss(raw, batch, terms=("objects",))
    assert {f"objects/{name}/denoising" for name in ("class", "center", "size", "yaw")} < set(losses)
    parts = [value for name, value in losses.items() if name != "total"]
    torch.testing.assert_close(losses["total"], torch.stack(parts).sum())
    losses["total"].backward()
    assert model.heads["objects"].denoising_queries.embedding.grad.abs().sum() > 0
    with torch.no_grad():
        told, alone = model.eval()(views, true_objects=known), model(views)
    assert told.denoising is None
    assert torch.equal(told.objects[-1].center, alone.objects[-1].center)


def test_volume_is_centred_on_the_cameras_unless_told() -> None:
    model, views = make_model().eval(), make_views(scenes=2)
    by_default = model(views)
    mean = views.world_from_camera[:, :, :3, 3].mean(dim=1)
    torch.testing.assert_close(by_default.grid_center, mean)
    torch.testing.assert_close(model(views, grid_center=mean).occupancy, by_default.occupancy)
    assert not torch.allclose(model(views, grid_center=mean + 1).occupancy, by_default.occupancy)


def test_batched_equals_single() -> None:
    model, views = make_model().eval(), make_views(scenes=3)
    together = model(views)
    for scene in range(3):
        one = slice(scene, scene + 1)
        alone = model(Views(views.images[one], views.intrinsics[one], views.world_from_camera[one]))
        torch.testing.assert_close(together.occupancy[one], alone.occupancy, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(together.foreground[one], alone.foreground, rtol=1e-4, atol=1e-5)
        for a, b in zip(together.objects, alone.objects, strict=True):
            torch.testing.assert_close(a.center[one], b.center, rtol=1e-4, atol=1e-5)
            torch.testing.assert_close(a.class_logits[one], b.class_logits, rtol=1e-4, atol=1e-4)


def test_the_world_may_be_moved() -> None:
    """Cameras moved together move the centres and change nothing else."""
    model, views = make_model().eval(), make_views()
    moved = views.world_from_camera.clone()
    moved[..., :3, 3] += torch.tensor([8.0, -4.0, 2.0])
    here, there = model(views), model(Views(views.images, views.intrinsics, moved))
    torch.testing.assert_close(here.occupancy, there.occupancy, rtol=1e-3, atol=1e-4)
    shift = there.objects[-1].center - here.objects[-1].center
    torch.testing.assert_close(shift, torch.tensor([8.0, -4.0, 2.0]).expand_as(shift), rtol=1e-3, atol=1e-3)


def test_a_few_views_at_once_give_the_same_prediction() -> None:
    model, views = make_model().eval(), make_views(views=5)
    together, apart = model.predict(views), model.predict(views, views_at_once=2)
    torch.testing.assert_close(together.occupancy, apart.occupancy, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(together.foreground, apart.foreground, rtol=1e-5, atol=1e-6)
    assert together.objects.label.tolist() == apart.objects.label.tolist()
    for name in ("center", "size", "score", "shape"):
        together_, apart_ = getattr(together.objects, name), getattr(apart.objects, name)
        torch.testing.assert_close(together_, apart_, rtol=1e-4, atol=1e-5)


def test_frames_and_image_size_may_change_from_batch_to_batch() -> None:
    model = make_model().eval()
    first = model(make_views(views=2))
    for views, scenes, size in ((1, 1, (16, 16)), (4, 2, (48, 32))):
        cameras = make_views(scenes=scenes, views=views)
        images = torch.zeros(scenes, views, 3, *size, dtype=torch.uint8)
        raw = model(Views(images, cameras.intrinsics, cameras.world_from_camera))
        assert raw.foreground.shape == (scenes, views, *size)
        assert raw.occupancy.shape == (scenes, *RESOLUTION)
    torch.testing.assert_close(model(make_views(views=2)).occupancy, first.occupancy)


def test_bytes_equal_floats_and_masks_are_a_fourth_channel() -> None:
    model, views = make_model(input_channels=4).eval(), make_views(channels=4)
    as_float = Views(views.images / 255, views.intrinsics, views.world_from_camera)
    torch.testing.assert_close(model(views).occupancy, model(as_float).occupancy)
    with pytest.raises(ShapeError, match="images"):
        model(make_views())


def test_sides_must_be_divisible_by_16() -> None:
    views = make_views()
    with pytest.raises(ShapeError, match="divisible by 16"):
        make_model()(Views(views.images[..., :30, :], views.intrinsics, views.world_from_camera))


@pytest.mark.parametrize(
    ("trained", "terms"),
    [
        (("occupancy",), ("occupancy",)),
        (TASKS, TASKS),
        ((*TASKS, "shape"), (*TASKS, "shape")),
        (("view",), ("view",)),
        (("occupancy", "view"), ("occupancy", "view")),
    ],
)
def test_every_parameter_in_use_gets_a_gradient_and_no_other(
    trained: tuple[str, ...], terms: tuple[str, ...]
) -> None:
    model, views = make_model(), make_views()
    new_views = make_views(views=3)
    tasks = [name for name in trained if name != "shape"]
    raw = model(views, tasks=tasks, new_cameras=Cameras.of(new_views))
    batch = SceneBatch(
        ("a",),
        views,
        (("0", "1"),),
        raw.grid_center,
        objects=(make_objects(3),),
        occupancy=torch.rand(1, *RESOLUTION) > 0.5,
        foreground=torch.rand(1, 2, 32, 48) > 0.5,
        new_views=new_views,
    )
    loss = TotalLoss(weights=WEIGHTS, matcher=HungarianMatcher(weights=WEIGHTS))
    loss(raw, batch, terms=terms, decode_shapes=model.decode_shapes)["total"].backward()
    idle = model.idle_modules(trained)
    for name, parameter in model.named_parameters():
        expected = not any(name.startswith(prefix) for prefix in idle)
        assert (parameter.grad is not None and bool(parameter.grad.any())) == expected, name


def raw_with(scores: list[float]) -> RawScene:
    """Slots whose best class is their number, at the given probability; the rest of it is padding."""
    probability = torch.full((1, len(scores), 10), 1e-9)
    for slot, score in enumerate(scores):
        probability[0, slot, slot] = score
        probability[0, slot, 9] = 1 - score
    count = len(scores)
    objects = RawObjects(
        class_logits=probability.log(),
        center=torch.arange(3.0 * count).view(1, count, 3),
        log_size=torch.full((1, count, 3), math.log(2.0)),
        yaw_vector=torch.tensor([3.0, 0.0]).expand(1, count, 2),
        embedding=torch.randn(1, count, CHANNELS),
    )
    return RawScene(torch.zeros(1, 3), occupancy=torch.zeros(1, 2, 2, 2), objects=(objects,))


def test_decode() -> None:
    (prediction,) = make_model().decode(raw_with([0.2, 0.9, 0.6]), ["scene"], score_threshold=0.5)
    objects = prediction.objects
    assert prediction.scene_id == "scene"
    assert objects.label.tolist() == [1, 2]
    torch.testing.assert_close(objects.score, torch.tensor([0.9, 0.6]))
    torch.testing.assert_close(objects.center, torch.tensor([[3.0, 4, 5], [6, 7, 8]]))
    torch.testing.assert_close(objects.size, torch.full((2, 3), 2.0))
    torch.testing.assert_close(yaw_from_rotation(objects.rotation), torch.full((2,), math.pi / 2))
    assert objects.shape.shape == (2, 63, 63, 63)
    torch.testing.assert_close(prediction.occupancy, torch.full((2, 2, 2), 0.5))


def test_scaled_scores_choose_the_same_objects_by_their_own_threshold() -> None:
    model, raw = make_model(), raw_with([0.2, 0.9, 0.49, 0.51])
    assert model.score_threshold == 0.5
    model.score_scaling = ScoreScaling(0.8, -2.0)
    assert model.score_threshold == pytest.approx(1 / (1 + math.exp(2.0)))
    (found,) = model.decode(raw, ["scene"], score_threshold=model.score_threshold, with_shapes=False)
    assert found.objects.label.tolist() == [1, 3]
    assert len(model.decode(raw, ["scene"], score_threshold=0.5, with_shapes=False)[0].objects) == 0


def test_decode_of_nothing_and_without_shapes() -> None:
    model = make_model()
    (prediction,) = model.decode(raw_with([0.2, 0.1]), ["scene"], score_threshold=0.5)
    assert len(prediction.objects) == 0
    assert prediction.objects.shape.shape == (0, 63, 63, 63)
    (prediction,) = model.decode(raw_with([0.2, 0.1]), ["scene"], with_shapes=False)
    assert len(prediction.objects) == 2
    assert prediction.objects.shape is None


def test_what_autocast_left_in_16_bits_is_decoded_outside_of_it() -> None:
    model, raw = make_model(), raw_with([0.9, 0.6])
    last = raw.objects[-1]
    short = replace(raw, objects=(replace(last, embedding=last.embedding.bfloat16()),))
    decoded, expected = (model.decode(each, ["scene"])[0].objects.shape for each in (short, raw))
    torch.testing.assert_close(decoded, expected, atol=0.02, rtol=0)


def test_predict_runs_in_eval_mode_without_gradients() -> None:
    model = make_model().train()
    statistics = model.backbone.encoder.bn1.running_mean.clone()
    prediction = model.predict(make_views(), scene_id="a")
    assert len(prediction.objects) == 5
    assert prediction.objects.score.tolist() == sorted(prediction.objects.score.tolist(), reverse=True)
    assert not prediction.objects.center.requires_grad
    torch.testing.assert_close(model.backbone.encoder.bn1.running_mean, statistics)
    assert prediction.foreground.shape == (2, 32, 48)


def test_predict_says_how_many_views_saw_each_voxel_of_the_volume() -> None:
    model, views = make_model(), make_views(views=3)
    prediction = model.predict(views)
    assert prediction.seen.shape == RESOLUTION
    assert prediction.seen.max() == 3
    behind, before = prediction.seen[:, :2], prediction.seen[:, 4:]
    assert behind.max() == 0  # all look along +y
    assert (before > 0).float().mean() > 0.4
    away = model.predict(views, grid_center=torch.tensor([0.0, -50.0, 0.0]))
    assert away.grid_center.tolist() == [0.0, -50.0, 0.0]
    assert away.seen.max() == 0


def test_stride_8_and_proposed_queries() -> None:
    model, views = make_model(stride=8, widths=(8, 4), queries="proposal"), make_views(scenes=2)
    raw = model(views)
    assert raw.foreground is not None
    assert raw.foreground.shape == (2, 2, 32, 48)
    assert raw.objects is not None
    assert raw.objects[-1].center.shape == (2, 5, 3)
    assert raw.proposals is not None
    assert raw.proposals.class_logits.shape == (2, *RESOLUTION, 9)
    assert len(model.predict(make_views(), with_shapes=False).objects) == 5
    with pytest.raises(ConfigError, match="one width for each halving"):
        make_model(stride=8)


def test_the_encoder_never_sees_the_new_cameras() -> None:
    """Neither what the view head is given of the scene nor any other task depends on what is rendered."""
    model, views = make_model().eval(), make_views(scenes=2)
    given: list[torch.Tensor] = []
    model.heads["view"].register_forward_pre_hook(lambda _, inputs: given.append(inputs[0]))

    def run(new_cameras: Cameras) -> RawScene:
        return model(views, tasks=(*TASKS, "view"), new_cameras=new_cameras)

    here, there = (Cameras.of(make_views(scenes=2, views=count)) for count in (1, 4))
    moved = there.world_from_camera.clone()
    moved[..., :3, 3] += torch.tensor([0.7, -1.0, 0.3])
    first, second = run(here), run(Cameras(1.3 * there.intrinsics, moved, (64, 32)))
    assert torch.equal(given[0], given[1])
    assert torch.equal(first.grid_center, second.grid_center)
    assert torch.equal(first.occupancy, second.occupancy)
    assert torch.equal(first.foreground, second.foreground)
    assert torch.equal(first.objects[-1].center, second.objects[-1].center)
    assert first.new_views.shape == (2, 1, 3, 32, 48)
    assert second.new_views.shape == (2, 4, 3, 64, 32)


def test_rendering_a_few_views_at_once_gives_the_same_images() -> None:
    model, views = make_model(), make_views(views=3)
    cameras = Cameras.of(make_views(views=5))
    (together,), apart = model.render(views, cameras), list(model.render(views, cameras, views_at_once=2))
    assert [len(images) for images in apart] == [2, 2, 1]
    assert not model.training
    assert together.shape == (5, 3, 32, 48)
    assert together.min() > 0
    assert together.max() < 1
    torch.testing.assert_close(together, torch.cat(apart), rtol=1e-4, atol=1e-5)
    raw = model(views, tasks=("view",), new_cameras=cameras)
    torch.testing.assert_close(together, model.decode(raw, ["a"])[0].new_views)
    center = views.world_from_camera[0, :, :3, 3].mean(dim=0) + 0.5
    (moved,) = model.render(views, cameras, grid_center=center)
    assert not torch.allclose(moved, together, atol=1e-4)


def test_what_rendering_needs_is_said() -> None:
    model, views = make_model().eval(), make_views()
    with pytest.raises(ConfigError, match="needs new_cameras"):
        model(views, tasks=("view",))
    odd = Cameras(views.intrinsics, views.world_from_camera, (30, 48))
    with pytest.raises(ShapeError, match="divisible by 16, got 30x48"):
        next(model.render(views, odd))
    del model.heads["view"]
    with pytest.raises(ConfigError, match="train experiment=novel_view"):
        next(model.render(views, Cameras.of(views)))


def test_a_prediction_checks_its_views_unless_told_not_to() -> None:
    """As commands check those of files: one sentence that names the view, and no numbers."""
    model, views = make_model(), make_views()
    pose, matrix = views.world_from_camera.clone(), views.intrinsics.clone()
    pose[0, 1, 0, 3], matrix[0, 1, 0, 0] = float("nan"), float("inf")
    colors = views.images / 255
    colors[0, 1, 2, 3, 4] = float("nan")
    for spoiled, fault in (
        (replace(views, world_from_camera=pose), "a pose that is not finite"),
        (replace(views, intrinsics=matrix), "intrinsics that are not finite"),
        (replace(views, images=colors), "colours that are no numbers"),
    ):
        with pytest.raises(DataError, match=f"^view 1 has {fault}"):
            model.predict(spoiled)
        with pytest.raises(DataError, match=f"^view 1 has {fault}"):
            next(model.render(spoiled, Cameras.of(views)))
        assert model.predict(spoiled, check=False, with_shapes=False).scene_id == ""
    with pytest.raises(ShapeError, match=r"images of shape \(1, N, 3, H, W\)"):
        model.predict(make_views(scenes=2), check=False)
    with pytest.raises(DataError, match=r"^grid_center is not finite"):
        model.predict(views, grid_center=torch.tensor([0.0, float("nan"), 0.0]))
    with pytest.raises(DataError, match="grid_center are on meta and images on cpu"):
        model.predict(views, grid_center=torch.zeros(3, device="meta"))
    with pytest.raises(ShapeError, match="grid_center of shape"):
        model.predict(views, grid_center=torch.zeros(1, 3))


def test_cameras_of_numpy_give_the_same_as_those_of_files() -> None:
    """Poses that numpy computed are of float64; commands bring them to float32."""
    model, views = make_model(), make_views()
    precise = replace(
        views, intrinsics=views.intrinsics.double(), world_from_camera=views.world_from_camera.double()
    )
    expected, found = (model.predict(some, with_shapes=False).objects for some in (views, precise))
    assert torch.equal(found.center, expected.center)


def test_what_fills_an_image_up_is_read_by_no_voxel() -> None:
    """A frame 16 wide in an image of 48: no pair joins a voxel with what lies beside it."""
    model, views = make_model().eval(), make_views(views=3)
    picture = torch.tensor([16.0, 0.0, 32.0, 32.0]).expand(1, 3, 4)
    part = replace(views, picture=picture)
    grid = VoxelGrid(model.grid_resolution, model.grid_extent, torch.zeros(1, 3))
    pairs = model.trace(Cameras.of(part), grid)
    assert set((pairs.pixel_index % 3).tolist()) == {1}
    seen, whole = (model.predict(some, with_shapes=False).seen for some in (part, views))
    assert 0 < seen.sum() < whole.sum()
    assert (seen <= whole).all()
    together, apart = model.predict(part), model.predict(part, views_at_once=2)
    assert torch.equal(together.seen, apart.seen)
    torch.testing.assert_close(together.occupancy, apart.occupancy, rtol=1e-5, atol=1e-6)
    everything = replace(views, picture=torch.tensor([0.0, 0, 48, 32]).expand(1, 3, 4))
    expected, found = (model.predict(some, with_shapes=False) for some in (views, everything))
    assert torch.equal(found.occupancy, expected.occupancy)
    assert torch.equal(found.seen, expected.seen)
