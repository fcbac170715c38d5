# SPDX-License-Identifier: Apache-2.0
"""Protocol map by the command: folders of boxes on both sides, Boxer's files, intervals and comparisons."""

from __future__ import annotations

import csv
import json
import math

import pytest

from raytran.errors import ConfigError, DataError
from raytran.run.entry import compose
from raytran.run.evaluate.evaluate import evaluate

HEADER = (
    "time_ns,tx_world_object,ty_world_object,tz_world_object,qw_world_object,qx_world_object,qy_world_object,"
    "qz_world_object,scale_x,scale_y,scale_z,name,instance,sem_id,prob"
)


def turned(yaw):
    return [[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]]


def box(category, center, size=(1, 1, 1), *, yaw=0.0, **more):
    return {"category": category, "center": center, "size": list(size), "rotation": turned(yaw), **more}


def write(folder, name, *objects):
    folder.mkdir(exist_ok=True)
    content = {"format": "raytran.scene/1", "scene_id": name, "up": "+z", "unit": "m"}
    (folder / f"{name}.json").write_text(json.dumps(content | {"objects": list(objects)}, indent=1))


@pytest.fixture
def files(tmp_path):
    """In a all is found and one box is wrong, in b the stand is turned, of c there is no file."""
    true = tmp_path / "true"
    write(true, "a", box("night stand", [0, 0, 0], score=None), box("bed", [5, 0, 0], (2, 1, 1)))
    write(true, "b", box("night stand", [0, 0, 0], (1, 0.5, 1)))
    write(true, "c", box("bed", [1, 1, 0]))
    found = tmp_path / "found"
    write(
        found,
        "a",
        box("night stand", [0, 0, 0.1], score=0.6),
        box("night stand", [9, 0, 0], score=0.7),
        box("bed", [5, 0, 0], (2, 1, 1), score=0.4),
        box("window", [5, 0, 0], score=0.9),
    )
    write(found, "b", box("night stand", [0, 0, 0], (1, 0.5, 1), yaw=math.pi / 2, score=0.5))
    write(found, "elsewhere", box("bed", [0, 0, 0], score=1.0))
    return tmp_path


def run(files, *settings, predictions="found", protocol="map", annotations="true", output="out"):
    given = [f"predictions={files / predictions}", f"annotations={files / annotations}"]
    given += [f"protocol={protocol}", f"output={files / output}", "num_resamples=20", *settings]
    found = evaluate(compose("evaluate", given))
    assert json.loads((files / output / "metrics.json").read_text()) == json.loads(json.dumps(found))
    return found


def test_by_hand(files, caplog, capsys):
    """Night stands: wrong, right, and in b an IoU of 1/3. Beds: one of two."""
    found = run(files)
    scores = found["map"]
    assert scores["iou_0.25"]["per_class"] == {"bed": 0.5, "night stand": pytest.approx(2 / 3)}
    assert scores["iou_0.25"]["mean"] == pytest.approx((0.5 + 2 / 3) / 2)
    assert scores["iou_0.5"]["per_class"] == {"bed": 0.5, "night stand": pytest.approx(0.5 / 2)}
    assert scores["iou_0.5"]["recall_per_class"] == {"bed": 0.5, "night stand": 0.5}
    assert (scores["boxes"], scores["n_scenes"]) == ("oriented", 3)
    assert scores["n_true"] == {"bed": 2, "night stand": 2}
    assert scores["confidence"]["map_0.25"]["value"] == scores["iou_0.25"]["mean"]
    assert scores["confidence"]["map_0.25"]["low"] < scores["confidence"]["map_0.25"]["high"]
    assert (found["n_scenes_with_predictions"], found["n_scenes_ignored"]) == (2, 1)
    assert found["n_predictions_of_other_classes"] == 1
    assert "1 of 3 scenes have no predictions, and count as scenes in which nothing was found" in caplog.text
    assert "ignored 1 scenes that are not asked for (elsewhere)" in caplog.text
    assert "left out 1 predictions of classes that are not asked for" in caplog.text
    screen = capsys.readouterr().out
    assert "night stand" in screen
    assert "58.3%" in screen
    with (files / "out" / "per_object.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["scene_id"], row["category"], row["matched_0.25"]) for row in rows] == [
        ("a", "night stand", "True"),
        ("a", "bed", "True"),
        ("b", "night stand", "True"),
        ("c", "bed", "False"),
    ]
    assert float(rows[2]["best_iou"]) == pytest.approx(1 / 3)
    assert {path.name for path in (files / "out").iterdir()} == {
        "metrics.json",
        "per_object.csv",
        "per_scene.csv",
    }


def test_the_form_of_the_boxes(files):
    """Turned by 45 degrees, the boxes around both have the IoU of the boxes along the axes."""
    write(files / "true", "b", box("night stand", [0, 0, 0], (1, 0.5, 1), yaw=math.pi / 4))
    write(files / "found", "b", box("night stand", [0, 0, 0], (1, 0.5, 1), yaw=-math.pi / 4, score=0.5))
    oriented, aligned = run(files), run(files, "boxes=axis_aligned")
    assert oriented["map"]["iou_0.5"]["recall_per_class"]["night stand"] == 0.5
    assert aligned["map"]["iou_0.5"]["recall_per_class"]["night stand"] == 1.0
    assert aligned["map"]["boxes"] == "axis_aligned"


def test_a_split_names_the_scenes(files):
    (files / "val.txt").write_text("a\n")
    scores = run(files, f"split={files / 'val.txt'}")["map"]
    assert (scores["n_scenes"], scores["n_true"]) == (1, {"bed": 1, "night stand": 1})
    assert scores["iou_0.5"]["mean"] == pytest.approx((1 + 0.5) / 2)


def test_comparison(files):
    write(files / "worse", "a", box("night stand", [0, 0, 0], score=0.5))
    found = run(files, f"compare={files / 'worse'}")["comparison"]["map"]
    assert found["map_0.25"]["first"] == pytest.approx((0.5 + 2 / 3) / 2)
    assert found["map_0.25"]["second"] == pytest.approx((0 + 0.5) / 2)
    assert found["map_0.25"]["n_scenes"] == 3
    assert run(files, f"compare={files / 'found'}")["comparison"]["map"]["map_0.5"]["p_value"] == 1


def boxer(*rows):
    lines = [
        ",".join(str(value) for value in (time, *center, *quaternion, *size, name, number, 32, score))
        for number, (time, center, quaternion, size, name, score) in enumerate(rows)
    ]
    return "\n".join([HEADER, *lines]) + "\n"


QUARTER = (math.sqrt(0.5), 0, 0, math.sqrt(0.5))
ROWS = [
    (0, (0, 0, 0.1), (1, 0, 0, 0), (1, 1, 1), "night stand", 0.6),
    (0, (9, 0, 0), (1, 0, 0, 0), (1, 1, 1), "night stand", 0.7),
    (0, (5, 0, 0), QUARTER, (1, 2, 1), "bed", 0.4),
    (0, (5, 0, 0), (1, 0, 0, 0), (1, 1, 1), "window", 0.9),
]


def test_boxers_files_score_as_ours(files, caplog):
    """Its folder of results, of which the fused boxes count, and a file that is named after its scene."""
    expected = run(files)
    folder = files / "boxer" / "a"
    folder.mkdir(parents=True)
    (folder / "boxer_3dbbs_fused.csv").write_text(boxer(*ROWS))
    (folder / "boxer_3dbbs_tracked.csv").write_text("not read")
    (folder / "boxer_3dbbs.csv").write_text("not read")
    (folder / "owl_2dbbs.csv").write_text("not read")
    row = (0, (0, 0, 0), QUARTER, (1, 0.5, 1), "night stand", 0.5)
    (files / "boxer" / "b.csv").write_text(boxer(row))
    assert run(files, predictions="boxer")["map"] == expected["map"]
    assert "frames" not in caplog.text
    # One scene, by its folder and by its file.
    (files / "found" / "b.json").unlink()
    alone = run(files)["map"]
    assert run(files, predictions="boxer/a")["map"] == alone
    assert run(files, predictions="boxer/a/boxer_3dbbs_fused.csv")["map"] == alone
    # Without those of all frames together each frame's count, of which a line warns.
    (folder / "boxer_3dbbs_fused.csv").unlink()
    (folder / "boxer_3dbbs_tracked.csv").unlink()
    (folder / "boxer_3dbbs.csv").write_text(boxer(*ROWS, (33, *ROWS[0][1:])))
    assert run(files, predictions="boxer/a")["map"]["n_predicted"]["night stand"] == 3
    assert "holds boxes of 2 frames, each of which counts as a prediction of its own: fuse" in caplog.text


def test_boxers_words_that_are_no_class_of_ours(tmp_path):
    """Boxes of words that protocol strict does not know are left out; a box of y up is compared with z up."""
    trs = {"translation": [0, 0, 0], "rotation": [1, 0, 0, 0], "scale": [1, 1, 1]}
    up = {"translation": [1, 2, 0.5], "rotation": [math.sqrt(0.5), math.sqrt(0.5), 0, 0], "scale": [1, 1, 1]}
    model = {"trs": up, "bbox": [0.25, 0.5, 0.3], "center": [0, 0, 0], "sym": "__SYM_NONE"}
    model |= {"catid_cad": "03001627", "id_cad": "c"}
    scene = {"id_scan": "a", "trs": trs, "n_aligned_models": 1, "aligned_models": [model]}
    (tmp_path / "annotations.json").write_text(json.dumps([scene]))
    (tmp_path / "found").mkdir()
    rows = [(0, (1, 2, 0.5), (1, 0, 0, 0), (0.5, 0.6, 1.0), name, 0.9) for name in ("chair", "armchair")]
    (tmp_path / "found" / "a.csv").write_text(boxer(*rows))
    found = run(tmp_path, annotations="annotations.json", protocol="strict")
    assert found["strict"]["global_average"] == 1.0
    assert found["strict"]["per_threshold"]["0.5"]["precision"] == 1.0
    assert found["n_predictions_of_other_classes"] == 1
    # Annotated CAD models are boxes too.
    scores = run(tmp_path, annotations="annotations.json")["map"]
    assert scores["iou_0.5"]["per_class"] == {"chair": 1.0}


def test_flat_boxes_count_and_overlap_with_nothing(files, caplog):
    write(files / "true", "b", box("night stand", [0, 0, 0], (1, 0, 1)))
    write(files / "found", "b", box("night stand", [0, 0, 0], (1, 0, 1), score=0.5))
    scores = run(files)["map"]
    assert scores["n_true"]["night stand"] == 2
    assert scores["iou_0.25"]["per_class"]["night stand"] == pytest.approx(0.5 / 2)
    assert "b.json: 1 boxes have no volume, and overlap with nothing" in caplog.text


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("found/a.csv", HEADER + "\n0,1,2\n", r"a\.csv, line 2 has 3 columns: write the 15 columns time_ns"),
        ("found/a.csv", boxer(ROWS[0]).replace(",0.6", ",nan"), r"a\.csv, line 2: prob is 'nan', write"),
        ("found/a.csv", boxer((0, (0, 0, 0), (0, 0, 0, 0), (1, 1, 1), "bed", 1)), "length zero"),
        ("found/a.csv", boxer((0, (0, 0, 0), (1, 0, 0, 0), (1, -1, 1), "bed", 1)), "line 2: a size is neg"),
        ("found/a.csv", boxer((0, (1e9, 0, 0), (1, 0, 0, 0), (1, 1, 1), "bed", 1)), "tx_world_object in li"),
        ("found/a.csv", boxer((0, (0, 0, 0), (1, 0, 0, 0), (1, 1, 1), "", 1)), "name in line 2 of .* is ''"),
    ],
)
def test_bad_files(files, name, content, message):
    (files / "found" / "a.json").unlink()
    (files / name).write_text(content)
    with pytest.raises(DataError, match=message) as error:
        run(files)
    assert "\n" not in str(error.value)
    assert not (files / "out").exists()


def test_bad_folders_and_settings(files):
    with pytest.raises(ConfigError, match=r"protocol=strict compares with Scan2CAD's full_annotations\.json"):
        run(files, protocol="strict")
    with pytest.raises(ConfigError, match="unknown boxes=upright, choose one of: oriented, axis_aligned"):
        run(files, "boxes=upright")
    with pytest.raises(
        ConfigError, match="protocol=odam is for predictions=, with checkpoint= choose strict"
    ):
        evaluate(compose("evaluate", ["checkpoint=default", "protocol=odam", f"output={files / 'out'}"]))
    (files / "empty").mkdir()
    with pytest.raises(DataError, match="empty holds no true boxes"):
        run(files, annotations="empty")
    write(files / "true", "c", box("bed", [1, 1, 0], score=0.5) | {"category": ""})
    with pytest.raises(DataError, match=r"category of an object in .*c\.json is '', no name"):
        run(files)
    write(files / "true", "c", box("bed", [1, 1, 0]))
    write(files / "found", "b", box("bed", [1, 1, 0]))
    with pytest.raises(DataError, match=r"score of the objects in .*b\.json does not hold 1 numbers"):
        run(files)
