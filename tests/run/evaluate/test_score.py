# SPDX-License-Identifier: Apache-2.0
"""The scorer command on scenes made by hand, every number computed by hand too."""

from __future__ import annotations

import csv
import json
import math
import random

import pytest
from PIL import Image

from raytran.errors import ConfigError, DataError
from raytran.pictures import accuracy_curves
from raytran.run.entry import compose
from raytran.run.evaluate.evaluate import evaluate
from raytran.run.output import one_writer

CHAIR, TABLE, SOFA, LAMP = "03001627", "04379243", "04256520", "03636649"
UPRIGHT = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)
"""Quaternion of +90 degrees about x: CAD +Y is up in the scan."""

TURNED = tuple(  # UPRIGHT, then 45 degrees about the object's up axis
    math.sqrt(0.5) * value
    for value in (math.cos(math.pi / 8), math.cos(math.pi / 8), math.sin(math.pi / 8), math.sin(math.pi / 8))
)


def model(catid, name, position, half, *, center=(0, 0, 0), sym="__SYM_NONE"):
    trs = {"translation": list(position), "rotation": list(UPRIGHT), "scale": [1, 1, 1]}
    return {
        "trs": trs,
        "bbox": list(half),
        "center": list(center),
        "sym": sym,
        "catid_cad": catid,
        "id_cad": name,
    }


def scene(name, *models):
    trs = {"translation": [0, 0, 0], "rotation": [1, 0, 0, 0], "scale": [1, 1, 1]}
    return {"id_scan": name, "trs": trs, "n_aligned_models": len(models), "aligned_models": list(models)}


# The chair's box centre stands 0.25 m above its CAD origin, and the point the official script compares with
# 0.25 m below. Of scene b nothing is predicted, of scene c there is no file.
SCENES = [
    scene(
        "a",
        model(CHAIR, "c1", (0, 0, 0), (0.25, 0.5, 0.25), center=(0, 0.25, 0)),
        model(TABLE, "t1", (2, 0, 0), (0.5, 0.4, 0.5), sym="__SYM_ROTATE_UP_INF"),
        model(LAMP, "l1", (0, 2, 0), (0.2, 0.4, 0.2)),
    ),
    scene("b", model(SOFA, "s1", (0, 0, 0), (1, 0.4, 0.5))),
    scene("c", model(CHAIR, "c1", (1, 1, 0), (0.25, 0.5, 0.25), center=(0, 0.25, 0))),
]


def row(catid, name, position, quaternion=UPRIGHT, scale=(1, 1, 1)):
    return ",".join(str(value) for value in (catid, name, *position, *quaternion, *scale)) + "\n"


ROWS = [row(CHAIR, "c1", (0, 0, 0)), row(TABLE, "t1", (2.15, 0, 0), TURNED), row(LAMP, "l1", (0, 2, 0))]


def box(category, center, size, **more):
    rotation = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    entry = {"category": category, "score": 0.9, "center": center, "size": size, "rotation": rotation}
    return entry | {"yaw": 0.0, "mesh": None} | more


def scene_json(name, *objects):
    content = {"format": "raytran.scene/1", "scene_id": name, "up": "+z", "unit": "m"}
    return json.dumps(content | {"objects": list(objects)}, indent=1)


@pytest.fixture
def files(tmp_path):
    """Annotations of three scenes, and predictions for two as CSV."""
    (tmp_path / "annotations.json").write_text(json.dumps(SCENES))
    (tmp_path / "csv").mkdir()
    (tmp_path / "csv" / "a.csv").write_text("".join(ROWS))
    (tmp_path / "csv" / "b.csv").write_text("")
    return tmp_path


def run(files, *settings, predictions="csv", output="out"):
    given = [f"predictions={files / predictions}", f"annotations={files / 'annotations.json'}"]
    found = evaluate(compose("evaluate", [*given, f"output={files / output}", "num_resamples=50", *settings]))
    assert json.loads((files / output / "metrics.json").read_text()) == json.loads(json.dumps(found))
    return found


def counts(metrics):
    return {
        name: (entry["n_good"], entry["n_total"])
        for name, entry in metrics["per_class"].items()
        if entry["n_total"]
    }


def detection(metrics, threshold):
    entry = metrics["per_threshold"][threshold]
    return [entry[name] for name in ("n_matched", "n_predicted", "n_true")]


def test_strict(files):
    found = run(files)["strict"]
    assert counts(found) == {"chair": (1, 2), "sofa": (0, 1), "table": (1, 1), "other": (1, 1)}
    assert found["global_average"] == pytest.approx(3 / 5)
    assert found["class_average"] == pytest.approx((1 / 2 + 0 + 1 + 1) / 4)
    assert found["n_scenes"] == 3
    assert detection(found, "0.25") == detection(found, "0.5") == [3, 3, 5]
    assert found["per_threshold"]["0.5"]["f1"] == pytest.approx(2 * 3 / 8)
    assert found["atlas"]["objects"] | {"found": 3, "missed": 2} == found["atlas"]["objects"]
    at_one = found["curves"]["joint"]["threshold"].index(1.0)
    assert found["curves"]["joint"]["global_average"][at_one] == pytest.approx(3 / 5)
    at_10_cm = found["curves"]["translation"]["threshold"].index(0.1)
    assert found["curves"]["translation"]["global_average"][at_10_cm] == pytest.approx(2 / 5)
    assert found["by_scene_size"]["10"]["n_total"] == 5
    assert 0 <= found["confidence"]["global_average"]["low"] <= 0.6 <= 0.75


def drawn(monkeypatch):
    """Names and lines of the figures that are drawn from now on."""
    found = []
    real = accuracy_curves.accuracy_figure
    monkeypatch.setattr(
        accuracy_curves, "accuracy_figure", lambda results: found.append(dict(results)) or real(results)
    )
    return found


def test_the_curves_are_drawn_too(files, capsys, caplog, monkeypatch):
    figures = drawn(monkeypatch)
    with caplog.at_level("INFO", "raytran"):
        found = run(files)
    assert "accuracy_curves.png" in caplog.text
    with Image.open(files / "out" / "accuracy_curves.png") as picture:
        assert picture.format == "PNG"
    assert figures == [{"out": found["strict"]["curves"]}]


def test_other_results_are_drawn_beside(files, monkeypatch):
    """Those of other predictions, and those of folders written before, by their names."""
    (files / "worse").mkdir()
    (files / "worse" / "a.csv").write_text(ROWS[0])
    earlier = run(files, predictions="worse", output="earlier")["strict"]["curves"]
    figures = drawn(monkeypatch)
    settings = [f"compare={files / 'worse'}", f"draw_with=[{files / 'earlier'}]"]
    own = run(files, *settings)["strict"]["curves"]
    (figure,) = figures
    assert list(figure) == [str(files / "csv"), str(files / "worse"), str(files / "earlier")]
    assert list(figure.values()) == [own, earlier, earlier]
    assert own != earlier


@pytest.mark.parametrize("content", [None, "", "[]", "{}", '{"strict": {"curves": {"translation": {}}}}'])
def test_folders_without_curves_are_one_sentence(files, content):
    (files / "earlier").mkdir()
    if content is not None:
        (files / "earlier" / "metrics.json").write_text(content)
    with pytest.raises(ConfigError, match=r"earlier/metrics\.json has no curves of protocol strict to draw"):
        run(files, f"draw_with=[{files / 'earlier'}]")
    assert not (files / "out").exists()


def test_without_the_strict_protocol_there_is_no_figure(files):
    run(files, "protocol=odam")
    assert not (files / "out" / "accuracy_curves.png").exists()


def test_metrics_say_which_files(files):
    (files / "split.txt").write_text("a\nb\n")
    found = run(files, f"split={files / 'split.txt'}")
    assert (found["predictions"], found["split"]) == (str(files / "csv"), str(files / "split.txt"))
    assert run(files)["split"] is None


def test_scan2cad(files):
    found = run(files, "protocol=scan2cad")["scan2cad"]
    assert counts(found) == {"chair": (0, 1), "sofa": (0, 1), "table": (1, 1), "other": (1, 1)}
    assert found["global_average"] == pytest.approx(2 / 4)
    assert found["class_average"] == pytest.approx(2 / 4)
    assert found["n_scenes"] == 2


def test_vid2cad(files):
    found = run(files, "protocol=vid2cad")["vid2cad"]
    # No scene with predictions has a sofa: the script does not know the class.
    assert counts(found) == {"chair": (1, 2), "table": (1, 1)}
    assert found["global_average"] == pytest.approx(2 / 3)
    assert found["class_average"] == pytest.approx(3 / 4)
    assert found["confidence"]["global_average"]["value"] == pytest.approx(2 / 3)


def test_odam(files):
    found = run(files, "protocol=odam")["odam"]
    assert detection(found, "0.25") == detection(found, "0.5") == [2, 2, 3]
    assert found["per_threshold"]["0.5"]["f1"] == pytest.approx(2 * 2 / 5)


def test_all_side_by_side(files, capsys):
    found = run(files, "protocol=all")
    for protocol in ("strict", "scan2cad", "vid2cad", "odam"):
        alone = run(files, f"protocol={protocol}", output=f"out_{protocol}")
        assert found[protocol] == alone[protocol]
    screen = capsys.readouterr().out
    assert all(name in screen for name in ("strict", "scan2cad", "vid2cad", "odam"))
    assert "60.0%" in screen
    with (files / "out" / "per_object.csv").open() as file:
        rows = list(csv.DictReader(file))
    per_protocol = {
        name: [row for row in rows if row["protocol"] == name] for name in found if name in screen
    }
    assert len(per_protocol["strict"]) == 5
    assert [row["matched"] for row in per_protocol["strict"]] == ["True"] * 3 + ["False"] * 2
    assert [row["cause"] for row in per_protocol["strict"]][3:] == ["missed", "missed"]
    assert len(per_protocol["scan2cad"]) == 4
    atlas = json.loads((files / "out" / "atlas.json").read_text())
    assert [(miss["scene_id"], miss["category"]) for miss in atlas["misses"]] == [
        ("b", "sofa"),
        ("c", "chair"),
    ]


def test_scene_json_with_cads_scores_as_the_csv(files):
    (files / "json" / "b").mkdir(parents=True)
    turned = [[math.sqrt(0.5), 0, math.sqrt(0.5)], [math.sqrt(0.5), 0, -math.sqrt(0.5)], [0, 1, 0]]
    objects = [
        box("chair", [0, 0, 0.25], [0.5, 1, 0.5], catid_cad=CHAIR, id_cad="c1"),
        box("table", [2.15, 0, 0], [1, 0.8, 1], catid_cad=TABLE, id_cad="t1", rotation=turned),
        box("other", [0, 2, 0], [0.4, 0.8, 0.4], catid_cad=LAMP, id_cad="l1"),
    ]
    (files / "json" / "a.json").write_text(scene_json("a", *objects))
    (files / "json" / "b" / "scene.json").write_text(scene_json("b"))
    as_csv, as_json = run(files, "protocol=all"), run(files, "protocol=all", predictions="json")
    for protocol in ("strict", "scan2cad", "vid2cad"):
        assert counts(as_json[protocol]) == counts(as_csv[protocol])
    for protocol in ("strict", "odam"):
        assert detection(as_json[protocol], "0.5") == detection(as_csv[protocol], "0.5")


def test_scene_json_without_cads(files, caplog):
    (files / "json").mkdir()
    (files / "json" / "a.json").write_text(scene_json("a", box("chair", [0, 0, 0.25], [0.5, 1, 0.5])))
    found = run(files, "protocol=all", predictions="json")
    assert "scan2cad" not in found
    assert "only strict, odam apply" in caplog.text
    assert counts(found["strict"])["chair"] == (1, 2)
    # ODAM's box of the annotated chair stands 0.25 m lower: overlap 0.75, union 1.25 m in height.
    assert detection(found["odam"], "0.5") == [1, 1, 2]
    with pytest.raises(ConfigError, match=r"a\.json has objects without catid_cad.*strict, odam"):
        run(files, "protocol=scan2cad", predictions="json")


def test_own_classes_are_scored_by_the_strict_protocol_alone(files):
    """Chairs are seats, a lamp is a lamp, and tables are of no class."""
    own = ["classes.names=[lamp,seat]", f'classes.catids=[["{LAMP}"],["{CHAIR}"]]']
    of_nine, found = run(files)["strict"], run(files, *own, "protocol=all", output="own")
    assert "scan2cad" not in found
    assert (
        list(found["strict"]["per_class"]) == list(found["strict"]["atlas"]["per_class"]) == ["lamp", "seat"]
    )
    assert counts(found["strict"]) == {"lamp": counts(of_nine)["other"], "seat": counts(of_nine)["chair"]}
    (files / "json").mkdir()
    (files / "json" / "a.json").write_text(scene_json("a", box("seat", [0, 0, 0.25], [0.5, 1, 0.5])))
    assert counts(run(files, *own, predictions="json", output="json-out")["strict"])["seat"] == (1, 2)
    for protocol in ("scan2cad", "vid2cad", "odam"):
        with pytest.raises(ConfigError, match=f"protocol {protocol} is defined on Scan2CAD's nine classes"):
            run(files, *own, f"protocol={protocol}", output="refused")
    with pytest.raises(DataError, match=r"none of the .* annotated objects, of categories"):
        run(files, "classes.names=[drill]", output="refused")


def test_comparison(files):
    (files / "other").mkdir()
    (files / "other" / "a.csv").write_text(ROWS[0] + ROWS[2])
    found = run(files, "protocol=all", f"compare={files / 'other'}")["comparison"]
    assert found["strict"]["global_average"]["difference"] == pytest.approx(1 / 5)
    assert found["strict"]["global_average"]["n_scenes"] == 3
    assert not found["strict"]["global_average"]["significant"]
    assert found["odam"]["f1_0.5"]["first"] == pytest.approx(2 * 2 / (2 + 2))  # scene a alone counts for both
    assert found["odam"]["f1_0.5"]["second"] == pytest.approx(2 * 1 / (1 + 2))


def test_one_csv_with_scores_of_all_scenes(files):
    # The worse chair has the higher score: it takes the category's only place, and its error is 0.5 m.
    lines = [
        row(f"a,{CHAIR}", "c1", (0, 0, 0)),
        row(f"a,{CHAIR}", "c1", (0.5, 0, 0)),
        row("x,1", "y", (0, 0, 0)),
    ]
    scores = [0.5, 0.9, 0.9]
    text = "".join(f"{line.strip()},{score}\n" for line, score in zip(lines, scores, strict=True))
    (files / "roca.csv").write_text(text)
    found = run(files, "protocol=all", predictions="roca.csv")
    assert counts(found["vid2cad"]) == {"chair": (0, 2), "table": (0, 1)}
    assert counts(found["strict"])["chair"] == (1, 2)
    assert found["n_scenes_ignored"] == 1


def test_cameras_tell_what_lies_outside_the_volume(files):
    for name, x in (("a", -3.0), ("b", 0.0), ("c", 6.0)):
        scan = files / "scans" / name
        for part in ("color", "pose", "intrinsic"):
            (scan / part).mkdir(parents=True)
        Image.new("RGB", (32, 24)).save(scan / "color" / "0.jpg")
        (scan / "pose" / "0.txt").write_text(f"1 0 0 {x}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
        (scan / "intrinsic" / "intrinsic_color.txt").write_text("30 0 16 0\n0 30 12 0\n0 0 1 0\n0 0 0 1\n")
    atlas = run(files, f"scans={files / 'scans'}")["strict"]["atlas"]["objects"]
    # The grid reaches 4.5 m: the chair of c at x = 1 lies outside, the sofa of b inside. Found stays found.
    assert (atlas["outside the volume"], atlas["missed"], atlas["found"]) == (1, 1, 3)
    (files / "scans" / "c" / "pose" / "0.txt").unlink()
    with pytest.raises(DataError):
        run(files, f"scans={files / 'scans'}")


def test_split_names_the_scenes(files):
    (files / "val.txt").write_text("a\nnot_annotated\n")
    found = run(files, f"split={files / 'val.txt'}")
    assert found["strict"]["n_total"] == 3
    assert found["n_scenes_ignored"] == 1
    (files / "val.txt").write_text("nothing")
    with pytest.raises(DataError, match=r"val\.txt names is annotated"):
        run(files, f"split={files / 'val.txt'}")


def test_what_is_unknown_is_counted(files, caplog):
    (files / "csv" / "nowhere.csv").write_text("not even a table")
    (files / "csv" / "a.csv").write_text("".join(ROWS) + row(CHAIR, "unknown", (0, 0, 0)))
    found = run(files)
    assert found["n_scenes_ignored"] == 1
    assert found["n_predictions_without_known_cad"] == 1
    assert detection(found["strict"], "0.5") == [3, 3, 5]
    assert "nowhere" in caplog.text
    assert "do not know the CAD model of 1 predictions" in caplog.text


def test_a_quaternion_of_any_length_is_a_rotation(files):
    doubled = row(CHAIR, "c1", (0, 0, 0), [2 * value for value in UPRIGHT])
    (files / "csv" / "a.csv").write_text(doubled)
    assert counts(run(files)["strict"])["chair"] == (1, 2)


def test_the_folder_of_one_predicted_scene(files):
    (files / "one").mkdir()
    (files / "one" / "scene.json").write_text(scene_json("a", box("chair", [0, 0, 0.25], [0.5, 1, 0.5])))
    assert counts(run(files, predictions="one")["strict"])["chair"] == (1, 2)


def test_header_row_and_empty_line(files):
    expected = run(files)["strict"]
    header = "catid_cad,id_cad,tx,ty,tz,qw,qx,qy,qz,sx,sy,sz\n"
    (files / "csv" / "a.csv").write_text(header + "\n".join(ROWS))
    assert run(files)["strict"] == expected


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("csv/a.csv", ROWS[0] + "a," + ROWS[1], r"a\.csv, line 2 has 13 columns"),
        ("csv/a.csv", row(CHAIR, "c1", (0, 0, 0), (math.nan, 0, 0, 0)), r"a\.csv, line 1: qw is 'nan'"),
        ("csv/a.csv", row(CHAIR, "c1", (0, 0, 0), (0, 0, 0, 0)), r"a\.csv, line 1: .* length zero"),
        ("csv/a.csv", row(CHAIR, "c1", (0, 0, 0), scale=(1, -1, 1)), r"a\.csv, line 1: a scale"),
        ("csv/a.csv", "x" * 200_000, r"cannot read the alignments .*a\.csv \(field larger"),
        ("csv/a.csv", ROWS[0].replace(",", "," + "y" * 9_000, 3), r"a\.csv, line 1: .* is 'y{50}', write"),
        ("csv/a.json", scene_json("a"), r"a\.csv and .*a\.json both hold scene a"),
        ("csv/c.json", scene_json("c", box("chair", [0, 0, 0], [1, -1, 1])), r"c\.json, line 8: a size"),
        ("csv/c.json", scene_json("c", box("chair", [0, 0, math.nan], [1, 1, 1])), "line 8: a number is not"),
        ("csv/c.json", scene_json("c", box("chair", [0, 0, 1e300], [1, 1, 1])), "line 8: a number is not"),
        ("csv/c.json", scene_json("c", box("chair", [0, 0, 0], [1, 1, 1e300])), "line 8: a number is not"),
        ("csv/c.json", scene_json("c", box("chair", [0, 0, 0], [10**400, 1, 1])), "line 8: a number is not"),
        ("csv/c.json", scene_json("c", box("chair", [0, 0, "0"], [1, 1, 1])), "center of the objects in"),
        (
            "csv/c.json",
            scene_json("c", box(["chair"], [0, 0, 0], [1, 1, 1])),
            r"category of an object in .* is \['chair'\]",
        ),
        ("csv/a.csv", row(CHAIR, "c1", (1e300, 0, 0)), r"tx in line 1 of .*a\.csv is 1e\+300"),
        ("csv/a.csv", row(CHAIR, "c1", (0, 0, 0), scale=(1e300, 1, 1)), "sx in line 1"),
        ("csv/a.csv", row(CHAIR, "c1", (0, 0, 0), scale=(1e-300, 1, 1)), r"a\.csv, line 1: a scale"),
        ("csv/a.csv", row(CHAIR, "c1", (0, 0, 0), scale=(1e6, 1, 1)), "a box of .* m: write sizes"),
        ("csv/c.json", scene_json("a"), r"c\.json says that it is scene 'a'"),
        ("csv/c.json", scene_json("c")[:50], r"c\.json is no valid JSON .*line \d"),
        ("annotations.json", json.dumps(SCENES)[:700], r"annotations\.json is no valid JSON .*line 1"),
        ("annotations.json", json.dumps([*SCENES, SCENES[0]]), r"entry 3 of .*scene 'a' occurs twice"),
    ],
)
def test_bad_files(files, name, content, message):
    (files / name).write_text(content)
    with pytest.raises(DataError, match=message) as error:
        run(files)
    assert "\n" not in str(error.value)
    assert not (files / "out").exists()


def test_bad_settings(files):
    with pytest.raises(ConfigError, match="unknown protocol=best, choose one of: strict, scan2cad"):
        run(files, "protocol=best")
    with pytest.raises(ConfigError, match="either checkpoint=CKPT or predictions=DIR"):
        run(files, "checkpoint=x.ckpt")
    with pytest.raises(ConfigError, match="either checkpoint=CKPT or predictions=DIR"):
        evaluate(compose("evaluate", []))
    with pytest.raises(ConfigError, match="needs annotations=FILE"):
        evaluate(compose("evaluate", [f"predictions={files}"]))
    with pytest.raises(ConfigError, match="num_resamples=0 is too few"):
        run(files, "num_resamples=0")
    with pytest.raises(DataError, match="no predictions at"):
        run(files, predictions="nothing")
    (files / "empty").mkdir()
    with pytest.raises(DataError, match="holds no predictions for any of the 3 annotated scenes"):
        run(files, predictions="empty")
    with pytest.raises(ConfigError, match="no earlier result"):
        run(files, output="csv")


@pytest.mark.parametrize("spread", [0.0, 30.0])
def test_one_file_of_many_rows_needs_memory_by_rows(files, command, spread):
    """A table of all pairs of 5,000 rows took 29 GB; here are 1.5 GB beyond what torch itself maps."""
    rng = random.Random(0)
    rows = [
        row(CHAIR, "c1", (rng.uniform(0, spread), rng.uniform(0, spread), 0), rng.choice([UPRIGHT, TURNED]))
        for _ in range(5000)
    ]
    (files / "csv" / "a.csv").write_text("".join([ROWS[1], *rows]))
    limit = (
        "import resource; mapped = int(open('/proc/self/statm').read().split()[0]) * 4096;"
        "resource.setrlimit(resource.RLIMIT_AS, (mapped + 3 * 2**29,) * 2)"
    )
    settings = ["predictions=csv", "annotations=annotations.json", "output=out", "num_resamples=10"]
    done = command("evaluate", *settings, "protocol=all", folder=files, first=limit)
    assert done.returncode == 0, done.stderr
    found = json.loads((files / "out" / "metrics.json").read_text())
    assert {"strict", "scan2cad", "vid2cad", "odam"} <= found.keys()
    assert found["strict"]["per_class"]["table"]["n_good"] == 1


def test_two_evaluations_into_one_folder(files):
    with (
        one_writer(files / "out", marker="metrics.json"),
        pytest.raises(ConfigError, match=r"another process writes .*out \(number"),
    ):
        run(files, output="out")
    assert not (files / "out").exists()


def test_the_command_ends_with_one_sentence(files, command):
    (files / "csv" / "a.csv").write_text("a," + ROWS[0])
    settings = ["predictions=csv", "annotations=annotations.json", "output=out"]
    done = command("evaluate", *settings, folder=files)
    assert done.returncode == 1
    assert done.stderr.startswith("raytran: csv/a.csv, line 1 has 13 columns")
    assert len(done.stderr.splitlines()) == 1
