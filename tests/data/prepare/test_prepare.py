# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import errno
import json
import multiprocessing
import os
import random
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from raytran.data.dataset import scan2cad_dataset
from raytran.data.prepare import PrepareSettings, Released, prepare_scan2cad
from raytran.data.prepare.prepare import claimed
from raytran.data.scan2cad import read_annotations
from raytran.data.scannet.scan import read_scan, read_sens
from raytran.errors import ConfigError, DataError

SETTINGS = PrepareSettings((16, 24), max_frames=3)
SCAN = Path("scannet/scans/scene0000_00")


def entries(root):
    return json.loads((root / "scan2cad" / "full_annotations.json").read_text())


def rewrite(root, change):
    found = entries(root)
    change(found)
    (root / "scan2cad" / "full_annotations.json").write_text(json.dumps(found))


def test_frames_cameras_models_and_lists(released, prepare, tmp_path):
    out = tmp_path / "out"
    report = prepare(released, out).report
    before, after = read_scan(released / SCAN), read_scan(out / SCAN)
    # 3 of the frames 0, 10, 20, 100, evenly: the middles of thirds.
    assert after.frame_id == ("0", "20", "100")
    assert torch.equal(after.world_from_camera, before.world_from_camera[[0, 2, 3]])
    assert after.image_size == (16, 24)
    expected = before.intrinsics[[0, 2, 3]] * torch.tensor([[0.5], [0.5], [1.0]])
    assert torch.equal(after.intrinsics, expected)
    assert torch.equal(after.axis_alignment, before.axis_alignment)
    with Image.open(out / SCAN / "color" / "100.jpg") as image:
        assert image.size == (24, 16)
        assert np.abs(np.asarray(image).astype(int) - 100).max() <= 2
    for ending in ("obj", "solid.binvox"):
        name = f"shapenet/03001627/cube/models/model_normalized.{ending}"
        assert (out / name).is_file() == (released / name).is_file()
    assert entries(out) == entries(released)
    assert (out / "scannet/scannetv2_train.txt").read_text() == "scene0001_00\nscene0000_00\n"
    assert (out / "scannet/scannetv2_val.txt").read_text() == "scene0002_00\n"
    assert report["scans"] == {"prepared": 3, "train": 2, "val": 1}
    assert report["frames"]["written"] == 9
    assert report["objects"]["train"]["chair"] == 2
    assert not any(report["left_out"].values())
    assert not any(report["noticed"].values())


@pytest.mark.parametrize("form", ["cpp", "odam", "mmdetection3d", "frames_25k"])
def test_every_form_gives_the_same_files(released, prepare, scan_in_form, digests, tmp_path, form):
    prepare(released, tmp_path / "whole")
    shutil.rmtree(released / SCAN)
    scan_in_form(form, released / "scannet" / "elsewhere" / "scene0000_00")
    report = prepare(released, tmp_path / "out").report
    assert report["frames"]["forms"] == {"exporter": 2, form: 1}
    differ = digests(tmp_path / "whole").items() ^ digests(tmp_path / "out").items()
    assert {name for name, _ in differ} == {"report.json", "report.txt", str(SCAN / "prepared.json")}


def test_recordings_are_read_and_one_that_ends_early_is_named(released, prepare, write_sens, tmp_path):
    for number in (0, 1):
        shutil.rmtree(released / SCAN.with_name(f"scene000{number}_00"))
        path = write_sens(f"scene000{number}_00", frames=8, lost=[2], root=released)
    path.write_bytes(path.read_bytes()[:-2500])
    report = prepare(released, tmp_path / "out", settings=PrepareSettings((32, 48), max_frames=None)).report
    assert report["frames"]["forms"] == {"exporter": 1, "sens": 2}
    assert report["frames"]["dropped"]["pose is not finite or out of bounds"] == 2
    (cut,) = report["noticed"]["recordings_cut_short"].items()
    assert cut[0] == "scene0001_00"
    assert "ends after 5 of the 8 frames" in cut[1]
    whole = read_scan(tmp_path / "out" / SCAN)
    assert whole.frame_id == ("0", "1", "3", "4", "5", "6", "7")
    with read_sens(released / SCAN / "scene0000_00.sens") as recording:
        assert torch.equal(recording.world_from_camera, whole.world_from_camera)
        assert recording.color_bytes(3) == whole.image_path[3].read_bytes()
    part = read_scan(tmp_path / "out" / SCAN.with_name("scene0001_00"))
    assert part.frame_id == whole.frame_id[: len(part)]


def test_the_best_form_is_taken_and_the_next_if_it_is_damaged(released, prepare, write_sens, tmp_path):
    write_sens(root=released)
    assert prepare(released, tmp_path / "a").report["frames"]["forms"] == {"exporter": 2, "sens": 1}
    (released / SCAN / "scene0000_00.sens").write_bytes(b"damaged")
    report = prepare(released, tmp_path / "b").report
    assert report["frames"]["forms"] == {"exporter": 3}
    (reasons,) = report["noticed"]["other_source_used"].values()
    assert "scene0000_00.sens is no .sens recording" in reasons[0]


def test_a_frame_of_the_right_size_keeps_its_bytes(released, prepare, tmp_path):
    prepare(released, tmp_path / "out", settings=PrepareSettings((32, 48), max_frames=None))
    for frame in (0, 10, 20, 100):
        name = SCAN / "color" / f"{frame}.jpg"
        assert (tmp_path / "out" / name).read_bytes() == (released / name).read_bytes()


def test_training_finds_every_target_made(released, prepare, digests, tmp_path):
    out = tmp_path / "out"
    prepare(released, out)
    before = digests(out)
    dataset = scan2cad_dataset(
        out, "train", cache_dir=out / "cache", image_size=(16, 24), num_views=2, view_choice="random"
    )
    for index in range(len(dataset)):
        for epoch in range(4):
            assert dataset[epoch, index].foreground.any()
    assert digests(out) == before
    assert len([name for name in before if name.startswith("cache/foreground")]) == 9
    assert len([name for name in before if name.startswith("cache/shape")]) == 1


@pytest.mark.slow
def test_same_bytes_from_two_processes_elsewhere(released, prepare, digests, tmp_path):
    prepare(released, tmp_path / "a")
    prepare(released, tmp_path / "b", processes=2)
    assert digests(tmp_path / "a") == digests(tmp_path / "b")


def test_a_broken_off_run_is_finished_and_nothing_done_twice(released, prepare, digests, tmp_path):
    prepare(released, tmp_path / "whole")
    out = tmp_path / "out"
    prepare(released, out)
    shutil.rmtree(out / "scannet/scans/scene0001_00")
    for name in ("scannet/scans/.unfinished-x.1/x/color", "shapenet/03001627/.unfinished-abc/models"):
        (out / name).mkdir(parents=True)
    for name in (".unfinished-report.json.1", "cache/shape/aa/.unfinished-1-key"):
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text("half")
    (out / "report.json").unlink()
    kept = (out / SCAN / "color" / "0.jpg").stat()
    prepare(released, out)
    assert digests(out) == digests(tmp_path / "whole")
    assert not [path for path in out.rglob("*") if path.name.startswith(".")]
    assert (out / SCAN / "color" / "0.jpg").stat().st_mtime_ns == kept.st_mtime_ns


def test_twenty_kills_at_random_moments(released, prepare, digests, tmp_path):
    """Whatever is killed, the same command ends with the same bytes. The server imports everything once."""
    prepare(released, tmp_path / "whole")
    whole, out = digests(tmp_path / "whole"), tmp_path / "out"
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["raytran.data.prepare"])
    source = Released(released / "scannet", released / "shapenet", released / "scan2cad")
    options = {"processes": 1, "progress": False}
    rng, kills, longest = random.Random(0), 0, 30.0
    while kills < 20:
        started = time.monotonic()
        process = context.Process(target=prepare_scan2cad, args=(out, source, SETTINGS), kwargs=options)
        process.start()
        process.join(longest * rng.random() if longest < 30 else longest)
        if process.exitcode is None:
            process.kill()
            process.join()
            kills += 1
        else:
            assert process.exitcode == 0
            assert digests(out) == whole
            longest = min(longest, time.monotonic() - started)
            shutil.rmtree(out)
    prepare(released, out)
    assert digests(out) == whole


def test_a_part_first_then_the_rest(released, prepare, digests, tmp_path):
    out = tmp_path / "out"
    first = prepare(released, out, scenes=["scene0000*"]).report
    assert first["scans"] == {"prepared": 1, "train": 1, "val": 0}
    assert [entry["id_scan"] for entry in entries(out)] == ["scene0000_00"]
    prepare(released, out, splits=["val"])
    assert (out / "scannet/scannetv2_train.txt").read_text() == "scene0000_00\n"
    assert [entry["id_scan"] for entry in entries(out)] == ["scene0000_00", "scene0002_00"]
    prepare(released, out)
    prepare(released, tmp_path / "whole")
    assert digests(out) == digests(tmp_path / "whole")


def test_a_recording_may_go_once_its_scan_is_prepared(released, prepare, digests, tmp_path):
    """So the whole of ScanNet, a terabyte, need never be there at once."""
    prepare(released, tmp_path / "whole")
    stored = (released / "scannet" / "scans").rename(tmp_path / "stored")
    for scan in sorted(stored.iterdir()):
        shutil.rmtree(released / "scannet" / "scans", ignore_errors=True)
        shutil.copytree(scan, released / "scannet" / "scans" / scan.name)
        prepare(released, tmp_path / "out")
    whole, parts = digests(tmp_path / "whole"), digests(tmp_path / "out")
    reports = {"report.txt", "report.json"}  # that of the parts names scans that are prepared and not there
    assert {name: whole[name] for name in whole.keys() - reports} == {
        name: parts[name] for name in parts.keys() - reports
    }


def test_other_settings_are_refused(released, prepare, digests, tmp_path):
    out = tmp_path / "out"
    prepare(released, out)
    before = digests(out)
    with pytest.raises(DataError, match="another max_frames"):
        prepare(released, out, settings=PrepareSettings((16, 24), max_frames=2))
    rewrite(released, lambda found: found.pop())
    with pytest.raises(DataError, match="another annotations"):
        prepare(released, out)
    assert digests(out) == before


def test_a_folder_with_other_things_is_refused(released, prepare, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("")
    with pytest.raises(DataError, match="holds other things"):
        prepare(released, tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["thesis.tex"]


def test_objects_that_cannot_be_used_are_left_out_and_named(released, prepare, cube_entry, tmp_path):
    def change(found):
        found[0]["aligned_models"] += [
            cube_entry(id_cad="gone"),
            cube_entry(scale=(1, 0, 1)),
            cube_entry(bbox=[0, 0, 0]),
            cube_entry(bbox=[0.5, 0.5, 0]),
            cube_entry(sym="mirror"),
            cube_entry(id_cad="../../cube"),
            {"trs": None},
            7,
        ]
        found[1]["aligned_models"] = [cube_entry(id_cad="gone")]

    rewrite(released, change)
    out = tmp_path / "out"
    report = prepare(released, out).report
    left_out = [(part["model"], part["reason"]) for part in report["left_out"]["objects"]]
    assert len(left_out) == 8
    assert left_out.count(("03001627/gone", "no CAD file")) == 2
    assert left_out.count(("03001627/cube", "scale or box of size zero")) == 2
    assert any("unknown symmetry 'mirror'" in reason for _, reason in left_out)
    assert any("'../../cube'" in reason for _, reason in left_out)
    # The cube and the flat sheet remain; the scan whose only object is gone is not prepared.
    assert len(read_annotations(out / "scan2cad/full_annotations.json")["scene0000_00"].model_id) == 2
    assert entries(out)[0]["n_aligned_models"] == 2
    assert report["left_out"]["scans_without_usable_objects"] == ["scene0001_00"]
    assert report["scans"] == {"prepared": 2, "train": 1, "val": 1}


def test_a_damaged_cad_is_left_out_and_named(released, prepare, cube_entry, tmp_path):
    folder = released / "shapenet/03001627/torn/models"
    folder.mkdir(parents=True)
    (folder / "model_normalized.obj").write_text("v 0 0 0\nv 1 0")
    rewrite(released, lambda found: found[0]["aligned_models"].append(cube_entry(id_cad="torn")))
    report = prepare(released, tmp_path / "out").report
    (part,) = report["left_out"]["objects"]
    assert (part["scan"], part["model"]) == ("scene0000_00", "03001627/torn")
    assert "model_normalized.obj" in part["reason"]
    assert not (tmp_path / "out/shapenet/03001627/torn").exists()


def test_scans_and_annotations_that_do_not_meet_are_named(
    released, prepare, write_scan, cube_entry, tmp_path
):
    write_scan("scene0003_00", root=released)
    write_scan("scene0004_00", root=released)
    with (released / "scannet/scannetv2_val.txt").open("a") as file:
        file.write("scene0003_00\nscene0005_00\n")

    def change(found):
        found.append(found[0] | {"id_scan": "scene0005_00"})
        found.append(found[0] | {"id_scan": "scene0000_00", "aligned_models": []})
        found.append({"id_scan": "scene0006_00"})

    rewrite(released, change)
    report = prepare(released, tmp_path / "out").report
    assert report["left_out"]["scans_without_annotation"] == ["scene0003_00"]
    assert report["left_out"]["annotations_without_scan"] == ["scene0005_00"]
    assert report["left_out"]["scans_in_no_split"] == ["scene0004_00"]
    assert report["noticed"]["duplicate_annotations"] == ["scene0000_00"]
    (part,) = report["left_out"]["objects"]
    assert (part["scan"], part["model"]) == ("scene0006_00", "")
    assert report["scans"] == {"prepared": 3, "train": 2, "val": 1}


def test_a_corrupt_image_is_replaced_and_named(released, prepare, tmp_path):
    path = released / SCAN / "color" / "20.jpg"
    path.write_bytes(path.read_bytes()[:300])
    report = prepare(released, tmp_path / "out").report
    assert list(report["noticed"]["damaged_images"]) == ["scene0000_00"]
    assert list(report["noticed"]["damaged_images"]["scene0000_00"]) == ["20"]
    assert report["frames"]["damaged_images"] == 1
    assert read_scan(tmp_path / "out" / SCAN).frame_id == ("0", "10", "100")


def test_a_scan_without_readable_images_is_named_and_the_others_go_on(released, prepare, tmp_path):
    for path in (released / SCAN / "color").iterdir():
        path.write_bytes(b"no image")
    report = prepare(released, tmp_path / "out").report
    assert list(report["left_out"]["scans_failed"]) == ["scene0000_00"]
    assert report["scans"] == {"prepared": 2, "train": 1, "val": 1}
    assert not (tmp_path / "out" / SCAN).exists()
    # With the images restored the same command goes on.
    for number, path in enumerate((released / SCAN / "color").iterdir()):
        Image.new("RGB", (48, 32), (number, 0, 0)).save(path)
    assert prepare(released, tmp_path / "out").report["scans"]["prepared"] == 3


def test_without_a_single_usable_scan_the_command_fails(released, prepare, tmp_path):
    for path in released.rglob("intrinsic_color.txt"):
        path.unlink()
    with pytest.raises(DataError, match=r"no scan could be prepared \(.*intrinsic_color.txt is missing"):
        prepare(released, tmp_path / "out")
    assert "scans that cannot be read: 3" in (tmp_path / "out" / "report.txt").read_text()


def test_a_scan_in_two_places_is_taken_once(released, prepare, tmp_path):
    shutil.copytree(released / SCAN, released / "scannet/more/scene0000_00")
    shutil.rmtree(released / SCAN / "pose")
    report = prepare(released, tmp_path / "out").report
    assert len(report["noticed"]["duplicate_scans"]["scene0000_00"]) == 2
    assert report["scans"]["prepared"] == 3


def test_objects_outside_the_volume_are_counted(released, prepare, tmp_path):
    report = prepare(released, tmp_path / "out", grid_extent=(6.0, 9.0, 3.5)).report
    assert list(report["noticed"]["objects_outside_volume"]) == ["scene0001_00", "scene0002_00"]


def test_mirrored_and_flat_objects_are_kept_and_counted(released, prepare, cube_entry, tmp_path):
    more = [cube_entry(scale=(-1, 1, 1)), cube_entry(bbox=[0.5, 0.5, 0.0]), cube_entry(scale=(-1, -1, 1))]
    rewrite(released, lambda found: found[2]["aligned_models"].extend(more))
    report = prepare(released, tmp_path / "out").report
    assert report["noticed"]["objects_mirrored"] == {"scene0002_00": ["03001627/cube"]}
    assert report["noticed"]["objects_flat"] == {"scene0002_00": ["03001627/cube"]}
    assert report["objects"]["val"]["chair"] == 4


def test_frames_alone_need_no_annotation(released, prepare, tmp_path):
    report = prepare(released, tmp_path / "out", shapenet=None, scan2cad=None).report
    assert report["scans"]["prepared"] == 3
    assert not (tmp_path / "out/scan2cad").exists()
    with pytest.raises(ConfigError, match="shapenet="):
        prepare(released, tmp_path / "other", shapenet=None)


@pytest.mark.parametrize("full_after", range(0, 24, 3))
def test_a_full_disk_is_one_sentence_and_loses_nothing(
    released, prepare, digests, tmp_path, monkeypatch, full_after
):
    """The disk is full from some rename on; with room again the same command gives the same bytes."""
    prepare(released, tmp_path / "whole")
    out = tmp_path / "out"
    replace, count = os.replace, 0

    def full(*names):
        nonlocal count
        count += 1
        if count > full_after:
            raise OSError(errno.ENOSPC, "No space left on device")
        replace(*names)

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(DataError) as caught:
        prepare(released, out)
    assert "No space left on device" in str(caught.value)
    assert "same command again" in str(caught.value)
    monkeypatch.setattr(os, "replace", replace)
    prepare(released, out)
    assert digests(out) == digests(tmp_path / "whole")


def test_the_real_scan_goes_through_unchanged(shared_dir, prepare, tmp_path):
    real = shared_dir / "realdata" / "scene0470_00"
    out = tmp_path / "out"
    report = prepare(real, out, settings=PrepareSettings(masks=False)).report
    assert report["scans"] == {"prepared": 1}
    assert (report["frames"]["in_scans"], report["frames"]["written"]) == (62, 60)
    assert report["objects"]["all"]["chair"] == 5
    assert not any(report["left_out"].values())
    before = read_scan(real / "scannet/scans/scene0470_00")
    after = read_scan(out / "scannet/scans/scene0470_00")
    assert after.frame_id == before.frame_id
    assert torch.equal(after.world_from_camera, before.world_from_camera)
    assert torch.equal(after.intrinsics, before.intrinsics)
    assert torch.equal(after.axis_alignment, before.axis_alignment)
    for old, new in zip(before.image_path, after.image_path, strict=True):
        assert old.read_bytes() == new.read_bytes()
    assert entries(out) == entries(real)


def test_a_folder_without_cad_models_is_refused_before_anything_is_written(released, prepare, tmp_path):
    with pytest.raises(DataError, match=r"no CAD model .*scannet; give the folder that holds ShapeNetCore"):
        prepare(released, tmp_path / "out", shapenet=released / "scannet")
    assert not (tmp_path / "out").exists()


def test_a_new_folder_is_claimed_and_may_be_claimed_again(tmp_path):
    for _ in range(2):
        with claimed(tmp_path / "out", PrepareSettings(), {"annotations": "abc"}):
            found = json.loads((tmp_path / "out" / "prepare.json").read_text())
        assert found["image_size"] == [480, 640]
        assert found["annotations"] == "abc"


@pytest.mark.parametrize(
    ("settings", "sources", "named"),
    [
        (PrepareSettings(masks=False), {"annotations": "abc"}, "another masks;"),
        (PrepareSettings((96, 128), 5), {"annotations": "x"}, "another image_size, max_frames, annotations;"),
    ],
)
def test_a_folder_claimed_with_other_settings_is_refused(tmp_path, settings, sources, named):
    with claimed(tmp_path, PrepareSettings(), {"annotations": "abc"}):
        pass
    with pytest.raises(DataError, match=named), claimed(tmp_path, settings, sources):
        pass


def test_a_damaged_marker_is_refused(tmp_path):
    (tmp_path / "prepare.json").write_text("{")
    with pytest.raises(DataError, match=r"prepare\.json"), claimed(tmp_path, PrepareSettings(), {}):
        pass


def test_only_one_at_a_time(tmp_path):
    with claimed(tmp_path, PrepareSettings(), {}):
        again = claimed(tmp_path, PrepareSettings(), {})
        with pytest.raises(DataError, match="another process prepares"), again:
            pass
    with claimed(tmp_path, PrepareSettings(), {}):
        pass


@pytest.mark.parametrize("wrong", [{"image_size": (8, 640)}, {"max_frames": 1}])
def test_contradictions_are_refused(wrong):
    with pytest.raises(ConfigError, match="max_frames"):
        PrepareSettings(**wrong)
