# SPDX-License-Identifier: Apache-2.0
"""From files to batches: targets, determinism, workers, and what is said when something is missing."""

from __future__ import annotations

import hashlib
import io
import pickle
import shutil
from itertools import islice

import pytest
import torch
from torch.utils.data import DataLoader

from raytran.data import dataset as dataset_module
from raytran.data.augment import Augmentation
from raytran.data.collate import collate_scenes
from raytran.data.dataset import FewScenes, SceneDataset, few_scenes, scan2cad_dataset
from raytran.data.scannet.scan import load_views
from raytran.errors import ConfigError, DataError
from raytran.geometry.rotation import yaw_from_rotation
from raytran.structs import SHAPE_SIZE
from raytran.training.datamodule import SceneDataModule

SMALL = {"image_size": (32, 48), "num_views": 2, "grid_resolution": (8, 8, 4), "grid_extent": (8.0, 8.0, 4.0)}


def open_dataset(root, split="train", **options):
    return scan2cad_dataset(root, split, **{"cache_dir": root / "cache", **SMALL, **options})


def test_all_targets(cube_dataset) -> None:
    sample = open_dataset(cube_dataset, view_choice="even")[0]
    assert sample.scene_id == ("scene0000_00",)
    assert sample.frame_id == (("10", "100"),)
    assert sample.views.images.shape == (1, 2, 3, 32, 48)
    assert sample.views.images[0, :, 0, 0, 0].tolist() == [10, 100]
    # Cameras stand at x = 0.1 and x = 1.
    torch.testing.assert_close(sample.grid_center, torch.tensor([[0.55, 0.0, 1.0]]))
    (objects,) = sample.objects
    torch.testing.assert_close(objects.center, torch.tensor([[3.0, 0.0, 1.0]]))
    assert objects.shape.shape == (1, SHAPE_SIZE, SHAPE_SIZE, SHAPE_SIZE)
    assert objects.shape.all()
    # In the grid from (-3.45, -4, -1), voxels of 1 m: the cube spans x 5.95 … 6.95, y 3.5 … 4.5, z 1.5 … 2.5.
    expected = torch.zeros(1, 8, 8, 4, dtype=torch.bool)
    expected[0, 5:7, 3:5, 1:3] = True
    assert torch.equal(sample.occupancy, expected)
    # Near faces are 2.4 m and 1.5 m ahead: 16.7 and 26.7 pixels wide.
    assert sample.foreground.sum(dim=(2, 3)).tolist() == [[16 * 16, 26 * 26]]


def test_only_targets_that_were_asked_for(cube_dataset) -> None:
    sample = open_dataset(cube_dataset, targets=("occupancy",))[0]
    assert sample.objects is None
    assert sample.foreground is None
    assert sample.occupancy.any()
    sample = open_dataset(cube_dataset, targets=("objects", "occupancy"))[0]
    assert sample.objects[0].shape is None
    assert sample.occupancy.any()
    sample = open_dataset(cube_dataset, targets=())[0]
    assert sample.occupancy is None
    assert sample.views.images.shape[2] == 3


def test_mask_as_input(cube_dataset) -> None:
    sample = open_dataset(cube_dataset, targets=("foreground",), input_mask="amodal")[0]
    assert sample.views.images.shape == (1, 2, 4, 32, 48)
    assert torch.equal(sample.views.images[:, :, 3], sample.foreground.byte() * 255)


def test_second_reading_comes_from_the_cache_and_is_equal(cube_dataset) -> None:
    first = open_dataset(cube_dataset, view_choice="even")[0]
    entries = {path: path.stat().st_mtime_ns for path in (cube_dataset / "cache").rglob("*.z")}
    assert len(entries) == 3
    second = open_dataset(cube_dataset, view_choice="even")[0]
    assert {path: path.stat().st_mtime_ns for path in (cube_dataset / "cache").rglob("*.z")} == entries
    assert torch.equal(first.foreground, second.foreground)
    assert torch.equal(first.objects[0].shape, second.objects[0].shape)


def test_predict_sees_the_same_frames_as_even_choice(cube_dataset) -> None:
    sample = open_dataset(cube_dataset, view_choice="even", num_views=3)[0]
    folder = cube_dataset / "scannet" / "scans" / "scene0000_00"
    views, frame_id = load_views(folder, image_size=(32, 48), num_views=3)
    assert frame_id == sample.frame_id[0]
    assert torch.equal(views.images, sample.views.images)
    assert torch.equal(views.intrinsics, sample.views.intrinsics)


@pytest.fixture
def long_dataset(write_scan, write_cube, write_annotations, cube_entry, tmp_path):
    """Two scans of 30 frames."""
    write_cube()
    for name in ("scene0000_00", "scene0001_00"):
        write_scan(name, frames=range(30))
    write_annotations({name: [cube_entry()] for name in ("scene0000_00", "scene0001_00", "scene0002_00")})
    return tmp_path


def test_random_frames_depend_on_seed_epoch_and_index_alone(long_dataset) -> None:
    def frames(seed=0, epoch=0, index=0):
        dataset = open_dataset(long_dataset, num_views=6, targets=(), seed=seed)
        return dataset[epoch, index].frame_id[0]

    assert frames() == frames()
    assert len({frames(), frames(seed=1), frames(epoch=1), frames(index=1)}) == 4
    assert open_dataset(long_dataset, num_views=6, targets=())[1].frame_id[0] == frames(index=1)


def test_workers_give_what_the_process_itself_gives_in_every_epoch(long_dataset) -> None:
    dataset = open_dataset(long_dataset, num_views=6)
    loader = DataLoader(
        dataset,
        sampler=[(epoch, index) for epoch in range(3) for index in range(2)],
        batch_size=2,
        num_workers=2,
        collate_fn=collate_scenes,
    )
    seen = []
    for epoch, batch in enumerate(loader):
        expected = collate_scenes([dataset[epoch, 0], dataset[epoch, 1]])
        assert batch.frame_id == expected.frame_id
        assert torch.equal(batch.views.images, expected.views.images)
        assert torch.equal(batch.foreground, expected.foreground)
        assert torch.equal(batch.occupancy, expected.occupancy)
        seen.append(batch.frame_id)
    assert len(set(seen)) == 3


ALL = Augmentation(yaw_deg=180, shift=(0.5, 0.5, 0.2), mirror=0.5, brightness=0.2, frame_dropout=0.3)


def test_augmentation_depends_on_seed_epoch_and_index_alone(long_dataset) -> None:
    def sample(seed=0, epoch=0, index=0):
        return open_dataset(long_dataset, num_views=6, augmentation=ALL, seed=seed)[epoch, index]

    def state(sample):
        return [sample.views.images, sample.views.world_from_camera, sample.grid_center, sample.occupancy]

    assert all(map(torch.equal, state(sample()), state(sample())))
    yaws = [
        float(yaw_from_rotation(sample(**change).objects[0].rotation)[0])
        for change in ({}, {"seed": 1}, {"epoch": 1}, {"index": 1})
    ]
    assert len(set(yaws)) == 4


def test_augmented_workers_give_what_the_process_itself_gives(long_dataset) -> None:
    dataset = open_dataset(long_dataset, num_views=6, augmentation=ALL)
    items = [(3, 0), (3, 1)]
    (batch,) = DataLoader(dataset, sampler=items, batch_size=2, num_workers=1, collate_fn=collate_scenes)
    expected = collate_scenes([dataset[item] for item in items])
    assert torch.equal(batch.views.images, expected.views.images)
    assert torch.equal(batch.views.world_from_camera, expected.views.world_from_camera)
    assert torch.equal(batch.occupancy, expected.occupancy)


def test_batches_are_the_same_for_any_number_of_workers(long_dataset) -> None:
    """Workers are in different epochs at the same time: two scenes have twenty ends of an epoch in forty."""

    def digests(num_workers: int) -> list[str]:
        data = SceneDataModule(
            root=long_dataset,
            dataset=lambda root, split, **options: open_dataset(root, **options),
            targets=("occupancy",),
            num_views=6,
            num_workers=num_workers,
            augmentation=ALL,
        )
        found = []
        for batch in islice(data.train_dataloader(), 40):
            parts = batch.views.images, batch.views.world_from_camera, batch.grid_center, batch.occupancy
            found.append(hashlib.sha256(b"".join(part.numpy().tobytes() for part in parts)).hexdigest())
        return found

    expected = digests(0)
    assert len(set(expected)) == 40
    for num_workers in (1, 2, 4):
        assert digests(num_workers) == expected


def test_augmentation_that_is_off_is_none(long_dataset) -> None:
    plain = open_dataset(long_dataset, num_views=6)[1]
    off = open_dataset(long_dataset, num_views=6, augmentation=Augmentation())[1]
    assert plain.frame_id == off.frame_id
    assert torch.equal(plain.views.images, off.views.images)
    assert torch.equal(plain.occupancy, off.occupancy)


def test_augmentation_changes_neither_the_frames_drawn_nor_the_cached_masks(cube_dataset) -> None:
    plain = open_dataset(cube_dataset, view_choice="even")[0]
    entries = {path: path.stat().st_mtime_ns for path in (cube_dataset / "cache").rglob("*.z")}
    dataset = open_dataset(
        cube_dataset, view_choice="even", augmentation=Augmentation(mirror=1.0, yaw_deg=180)
    )
    for epoch in range(3):
        sample = dataset[epoch, 0]
        assert sample.frame_id == plain.frame_id
        assert torch.equal(sample.foreground, plain.foreground.flip(-1))
        assert sample.occupancy.any()
    assert {path: path.stat().st_mtime_ns for path in (cube_dataset / "cache").rglob("*.z")} == entries


def test_dropout_keeps_the_number_of_images(cube_dataset) -> None:
    dropping = Augmentation(frame_dropout=1.0)
    sample = open_dataset(cube_dataset, num_views=4, min_views=3, augmentation=dropping)[0]
    assert sample.views.images.shape[1] == 4
    assert len(set(sample.frame_id[0])) == 3


def test_dataset_can_be_pickled(long_dataset) -> None:
    dataset = open_dataset(long_dataset, num_views=6, targets=())
    assert pickle.loads(pickle.dumps(dataset))[5, 0].frame_id == dataset[5, 0].frame_id


def test_annotation_is_read_once(long_dataset, monkeypatch) -> None:
    read = []
    real = dataset_module.read_annotations
    monkeypatch.setattr(dataset_module, "read_annotations", lambda path: read.append(path) or real(path))
    (long_dataset / "scannet" / "scannetv2_train.txt").write_text("scene0001_00\n")
    open_dataset(long_dataset)
    assert len(read) == 1


def test_dataset_holds_few_tensors_however_many_scenes(long_dataset, write_annotations, cube_entry) -> None:
    """A worker process that is not forked gets each tensor by a file handle of its own."""
    scans = long_dataset / "scannet" / "scans"
    names = [f"scene{i:04d}_00" for i in range(300)]
    for name in names[2:]:
        (scans / name).symlink_to(scans / names[0])
    write_annotations({name: [cube_entry()] for name in names})
    dataset = open_dataset(long_dataset, num_views=6)
    for i in range(20):
        dataset[i]
    assert len(dataset) == 300
    tensors = []

    class Pickler(pickle.Pickler):
        def reducer_override(self, value):
            tensors.extend([value] if isinstance(value, torch.Tensor) else [])
            return NotImplemented

    content = io.BytesIO()
    Pickler(content).dump(dataset)
    assert len(tensors) < 10
    assert len(content.getvalue()) < 100_000
    copy = pickle.loads(content.getvalue())
    assert copy[299].scene_id == (names[299],)
    assert copy[299].frame_id == dataset[299].frame_id


def test_scan_with_too_few_frames_repeats_them(cube_dataset) -> None:
    for choice in ("random", "even"):
        sample = open_dataset(cube_dataset, num_views=8, view_choice=choice, targets=())[0]
        assert sorted(sample.frame_id[0]) == sorted(("0", "10", "20", "100") * 2)


def test_split_is_what_is_listed_and_annotated(long_dataset) -> None:
    (long_dataset / "scannet" / "scannetv2_train.txt").write_text("scene0001_00\nscene0009_00\n")
    (long_dataset / "scannet" / "scannetv2_val.txt").write_text("scene0000_00\n")
    assert open_dataset(long_dataset, "train").scene_ids == ("scene0001_00",)
    assert open_dataset(long_dataset, "val").scene_ids == ("scene0000_00",)
    with pytest.raises(DataError, match=r"scannetv2_test\.txt"):
        open_dataset(long_dataset, "test")
    (long_dataset / "scannet" / "scannetv2_val.txt").write_text("scene0009_00\n")
    with pytest.raises(DataError, match=r"no scene with objects in .*full_annotations\.json"):
        open_dataset(long_dataset, "val")
    (long_dataset / "scannet" / "scannetv2_val.txt").write_text("scene0002_00\n")
    with pytest.raises(DataError, match=r"1 of 1 scans are not in .* scene0002_00"):
        open_dataset(long_dataset, "val")


def test_without_split_files_all_annotated_scans_that_are_there(long_dataset) -> None:
    assert open_dataset(long_dataset).scene_ids == ("scene0000_00", "scene0001_00")


def test_empty_annotation(cube_dataset, write_annotations) -> None:
    for scenes in ({}, {"scene0000_00": []}):
        write_annotations(scenes)
        with pytest.raises(DataError, match=r"no scene with objects in .*full_annotations\.json"):
            open_dataset(cube_dataset)


def test_missing_folders(tmp_path, cube_dataset) -> None:
    with pytest.raises(DataError, match=r"there is no folder .*nowhere"):
        open_dataset(tmp_path / "nowhere")
    shutil.rmtree(cube_dataset / "shapenet")
    with pytest.raises(DataError, match="03001627"):
        _ = open_dataset(cube_dataset)[0]


def test_settings_that_contradict_each_other(cube_dataset) -> None:
    with pytest.raises(ConfigError, match="unknown targets"):
        open_dataset(cube_dataset, targets=("boxes",))
    with pytest.raises(ConfigError, match="view_choice"):
        open_dataset(cube_dataset, view_choice="first")
    paths = {"scans_root": cube_dataset / "scannet" / "scans", "cache_dir": cube_dataset / "cache"}
    with pytest.raises(ConfigError, match="annotations"):
        SceneDataset(**paths)
    with pytest.raises(ConfigError, match="shapenet_root"):
        SceneDataset(**paths, annotations=cube_dataset / "scan2cad" / "full_annotations.json")


def test_scans_without_annotation(cube_dataset) -> None:
    paths = {"scans_root": cube_dataset / "scannet" / "scans", "cache_dir": cube_dataset / "cache"}
    dataset = SceneDataset(**paths, targets=(), **SMALL)
    assert dataset.scene_ids == ("scene0000_00",)
    assert dataset[0].objects is None


def test_real_scan(shared_dir, tmp_path) -> None:
    root = shared_dir / "realdata" / "scene0470_00"
    dataset = scan2cad_dataset(root, "train", cache_dir=tmp_path, image_size=(120, 160), num_views=4)
    assert dataset.scene_ids == ("scene0470_00",)
    sample = dataset[0]
    assert len(sample.objects[0]) == 7
    assert sample.occupancy.shape == (1, 48, 48, 16)
    # Seven pieces of furniture fill little of 9 × 9 × 3.5 m.
    assert 7 < sample.occupancy.sum() < 1500
    assert sample.foreground.shape == (1, 4, 120, 160)


def test_real_walk_without_annotation(shared_dir, tmp_path) -> None:
    scans = shared_dir / "realdata" / "hololens_lounge" / "scans"
    dataset = SceneDataset(
        scans_root=scans, cache_dir=tmp_path, targets=(), num_views=2, image_size=(120, 160)
    )
    assert dataset.scene_ids == ("hololens_000",)
    assert dataset[0].views.images.shape == (1, 2, 3, 120, 160)


def test_frames_to_render_are_apart_from_those_to_see(long_dataset) -> None:
    """Views, masks, names and the volume's centre are of the frames that are seen alone."""
    options = {"num_views": 5, "num_new_views": 3, "targets": ("foreground",), "view_choice": "even"}
    sample = open_dataset(long_dataset, **options)[0]
    assert sample.views.images.shape[:2] == sample.foreground.shape[:2] == (1, 5)
    assert len(sample.frame_id[0]) == 5
    assert sample.new_views.images.shape == (1, 3, 3, 32, 48)
    plain = open_dataset(long_dataset, **options | {"num_views": 8, "num_new_views": 0})[0]
    places = [plain.frame_id[0].index(name) for name in sample.frame_id[0]]
    others = [place for place in range(8) if place not in places]
    assert torch.equal(sample.views.images, plain.views.images[:, places])
    assert torch.equal(sample.new_views.images, plain.views.images[:, others])
    assert torch.equal(sample.new_views.world_from_camera, plain.views.world_from_camera[:, others])
    assert torch.equal(sample.foreground, plain.foreground[:, places])
    positions = sample.views.world_from_camera[:, :, :3, 3]
    torch.testing.assert_close(sample.grid_center, positions.mean(dim=1))


def test_frames_to_render_change_with_the_epoch_and_with_the_scene(long_dataset) -> None:
    augmentation = Augmentation(yaw_deg=180, mirror=1.0)
    options = {"num_views": 4, "num_new_views": 2, "targets": (), "augmentation": augmentation}
    dataset = open_dataset(long_dataset, **options)
    first, again = dataset[0], dataset[0]
    assert torch.equal(first.new_views.world_from_camera, again.new_views.world_from_camera)
    assert not torch.equal(first.new_views.world_from_camera, dataset[1, 0].new_views.world_from_camera)
    batch = collate_scenes([dataset[1, 0], dataset[1, 1]])
    assert batch.new_views.images.shape[:2] == (2, 2)
    # The cameras of a scan stand on a line, and still do after one change of the whole scene.
    line = torch.cat([first.views.world_from_camera, first.new_views.world_from_camera], dim=1)[0, :, :3, 3]
    assert torch.linalg.svdvals(line - line.mean(dim=0))[1] < 1e-4


def test_too_few_frames_to_hold_some_out(cube_dataset) -> None:
    with pytest.raises(DataError, match="can be read and 6 are needed"):
        open_dataset(cube_dataset, num_views=4, num_new_views=4, targets=())[0]


def test_the_first_scenes_and_no_more():
    few = FewScenes(["a", "b", "c"], 2)
    assert (len(few), few[0], few[1]) == (2, "a", "b")
    with pytest.raises(IndexError):
        few[2]
    assert len(FewScenes(["a"], 5)) == 1


def test_the_same_frames_in_every_epoch_and_in_validation(cube_dataset):
    asked = {"root": cube_dataset, "cache_dir": cube_dataset / "cache", "num_scenes": 1, **SMALL}
    training = few_scenes(split="train", view_choice="random", **asked)
    first = training[0]
    validation = few_scenes(split="val", view_choice="even", **asked)
    for other in (training[7, 0], validation[0]):
        assert other.frame_id == first.frame_id == (("10", "100"),)
        assert torch.equal(other.views.images, first.views.images)


def test_objects_of_no_class_are_left_out_of_all_targets(
    cube_dataset, write_cube, write_annotations, cube_entry, caplog
):
    """A chair and, beside it, a bed: which of them there are, is what the classes say."""
    write_cube("02818832")
    bed = cube_entry(translation=(3.0, 1.5, 1.0), catid_cad="02818832")
    write_annotations({"scene0000_00": [cube_entry(), bed]})

    def opened(**classes):
        found = scan2cad_dataset(
            cube_dataset, "train", cache_dir=cube_dataset / "cache", classes=classes or None, **SMALL
        )
        return found[0]

    of_nine, both = opened(), opened(names=["bed", "chair"], catids=["02818832", None])
    assert of_nine.objects[0].category == ("chair", "other")
    assert both.objects[0].category == ("chair", "bed")
    assert torch.equal(both.foreground, of_nine.foreground)
    assert "belong to no class" not in caplog.text
    chair = opened(names=["chair"])
    assert chair.objects[0].category == ("chair",)
    assert len(chair.objects[0].shape) == 1
    assert (
        "1 of 2 annotated objects belong to no class and are left out, of categories '02818832'"
        in caplog.text
    )
    assert 0 < chair.foreground.sum() < both.foreground.sum()
    assert 0 < chair.occupancy.sum() < both.occupancy.sum()
    with pytest.raises(DataError, match="none of the 2 annotated objects"):
        opened(names=["drill"])


def test_objects_are_counted_without_reading_the_scene(cube_dataset):
    dataset = scan2cad_dataset(cube_dataset, "train", cache_dir=cube_dataset / "cache", **SMALL)
    assert [dataset.num_objects(index) for index in range(len(dataset))] == [len(dataset[0].objects[0])]
