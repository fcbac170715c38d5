# SPDX-License-Identifier: Apache-2.0
"""Result files of Scan2CAD and ROCA: what is read, and one sentence with file and line for what is not."""

from __future__ import annotations

import pytest
import torch

from raytran.errors import DataError
from raytran.export.cad_alignments import SCAN2CAD_COLUMNS, write_alignments_csv
from raytran.export.read import ROCA_COLUMNS, read_alignments_csv, read_predictions, read_roca_csv
from raytran.structs import CadAlignments

ROW = "03001627,abc,1,2,3,1,0,0,0,0.5,0.6,0.7"


def write(tmp_path, *lines):
    path = tmp_path / "scene0000_00.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_row(tmp_path):
    alignments = read_alignments_csv(write(tmp_path, ROW))
    assert alignments.model_id == ("03001627/abc",)
    assert alignments.category == ("chair",)
    numbers = [alignments.translation, alignments.quaternion, alignments.scale, alignments.score]
    assert [part[0].tolist() for part in numbers] == [[1, 2, 3], [1, 0, 0, 0], [0.5, 0.6, 0.7], 1]
    assert alignments.translation.dtype == torch.float64


def test_header_and_blank_lines_are_skipped(tmp_path, caplog):
    path = write(tmp_path, ",".join(SCAN2CAD_COLUMNS), "", ROW, "", ROW)
    assert len(read_alignments_csv(path)) == 2
    assert f"{path}, line 1" in caplog.text


def test_empty_file(tmp_path):
    assert len(read_alignments_csv(write(tmp_path, ""))) == 0


def test_categories_without_leading_zero_match_nothing(tmp_path, caplog):
    path = write(tmp_path, ROW, ROW.removeprefix("0"))
    assert read_alignments_csv(path).catid == ("03001627", "3001627")
    assert f"{path}, line 2: catid_cad '3001627'" in caplog.text


def test_quaternions_are_kept_as_given(tmp_path, caplog):
    path = write(tmp_path, ROW, ROW.replace("3,1,0,0,0", "3,-2,0,0,0"))
    assert read_alignments_csv(path).quaternion.tolist() == [[1, 0, 0, 0], [-2, 0, 0, 0]]
    assert f"{path}, line 2: the quaternion is not of length one" in caplog.text


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("scene0000_00," + ROW, "13 columns"),
        (ROW.rsplit(",", 1)[0], "11 columns"),
        (ROW.replace(",2,", ",nan,"), "ty is 'nan'"),
        (ROW.replace(",2,", ",two,"), "ty is 'two'"),
        (ROW.replace(",2,", ",,"), "ty is ''"),
        (ROW.replace("3,1,0,0,0", "3,0,0,0,0"), "length zero"),
        (ROW.replace("0.6", "-0.6"), "scale is not positive"),
        (",".join(SCAN2CAD_COLUMNS), "tx is 'tx'"),
    ],
)
def test_bad_rows(tmp_path, row, said):
    path = write(tmp_path, ROW, row)
    with pytest.raises(DataError) as error:
        read_alignments_csv(path)
    assert f"{path}, line 2" in str(error.value)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_missing_file_and_bytes_that_are_no_text(tmp_path):
    (tmp_path / "image.csv").write_bytes(b"\xff\xd8\xff")
    for name in ("none.csv", "image.csv"):
        with pytest.raises(DataError, match=name):
            read_alignments_csv(tmp_path / name)


def test_written_files_are_read_back_exactly(tmp_path, generator):
    numbers = torch.rand(5, 10, generator=generator, dtype=torch.float64) + 0.1
    catid, names = ("03001627", "04379243") * 2 + ("03636649",), tuple("abcde")
    given = CadAlignments(
        catid, names, numbers[:, :3], numbers[:, 3:7], numbers[:, 7:], torch.ones(5).double()
    )
    path = write_alignments_csv(tmp_path / "scene.csv", given)
    found = read_alignments_csv(path)
    assert (found.catid, found.id_cad) == (catid, names)
    for name in ("translation", "quaternion", "scale", "score"):
        assert torch.equal(getattr(found, name), getattr(given, name))
    assert all(line.count(",") == 11 for line in path.read_text().splitlines())
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene.csv"]
    assert len(read_alignments_csv(write_alignments_csv(path, CadAlignments.empty()))) == 0


def test_rocas_file_holds_many_scenes(tmp_path):
    rows = [
        f"{scene},{ROW.removeprefix('0')},{score}" for scene, score in (("b", 0.9), ("a", 0.2), ("b", 0.7))
    ]
    scenes = read_roca_csv(write(tmp_path, ",".join(ROCA_COLUMNS), *rows))
    assert list(scenes) == ["b", "a"]
    assert scenes["b"].score.tolist() == [0.9, 0.7]
    assert scenes["a"].model_id == ("03001627/abc",)
    with pytest.raises(DataError, match="line 1 has 12 columns"):
        read_roca_csv(write(tmp_path, ROW))


def test_a_thirteenth_column_is_the_score(tmp_path, caplog):
    path = write(
        tmp_path, ",".join([*SCAN2CAD_COLUMNS, "score"]), ROW + ",0.25", ROW.replace("abc", "1e5") + ",0.5"
    )
    alignments = read_alignments_csv(path)
    assert alignments.score.tolist() == [0.25, 0.5]
    assert alignments.model_id == ("03001627/abc", "03001627/1e5")
    assert f"{path}, line 1: skipped a header row" in caplog.text


def test_scan2cads_own_example_has_no_scores(tmp_path):
    header = "scanId,objectCategory,alignedModelId,tx,ty,tz,qw,qx,qy,qz,sx,sy,sz"
    for lines in ([header], []):
        rows = [f"scene0470_00,{ROW}", f"0470_00,{ROW.replace('abc', '1234')}"]
        scenes = read_roca_csv(write(tmp_path, *lines, *rows))
        assert list(scenes) == ["scene0470_00", "0470_00"]
        assert scenes["scene0470_00"].score.tolist() == [1]
        assert scenes["0470_00"].model_id == ("03001627/1234",)
        assert scenes["0470_00"].scale.tolist() == [[0.5, 0.6, 0.7]]


def test_vid2cads_file_leaves_out_what_all_scenes_are_called(tmp_path):
    """As ODAM reads it: the 15th column is the number of views, the 16th the score."""
    header = "id_scan,catid,id_cad,tx,ty,tz,qw,qx,qy,qz,sx,sy,sz,extra,num_frames,score"
    path = write(tmp_path, header, f"0470_00,{ROW},x,90,0.8", f"0011_00,{ROW},,7,0.1")
    scenes = read_roca_csv(path)
    assert list(scenes) == ["0470_00", "0011_00"]
    assert scenes["0470_00"].score.tolist() == [0.8]
    files = read_predictions(path, ["scene0470_00"], {})
    assert list(files.scenes) == ["scene0470_00"]
    assert files.ignored == ("0011_00",)
    # Where the annotations call their scenes so too, the names are as they are.
    assert list(read_predictions(path, ["0470_00", "scene0470_00"], {}).scenes) == ["0470_00"]


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([ROW + ",0.5"], "line 1 has 13 columns"),  # a score, but of which scene?
        ([f"scene0000_00,{ROW}", f"scene0000_00,{ROW},1"], "line 2 has 14 columns"),
        ([f"scene0000_00,{ROW},x,90,"], "score is ''"),
        ([f"scene0000_00,{ROW},1,2"], "line 1 has 15 columns: write the 14 columns .* or 13 or 16"),
    ],
)
def test_rows_of_no_form(tmp_path, rows, said):
    with pytest.raises(DataError, match=said) as caught:
        read_roca_csv(write(tmp_path, *rows))
    assert len(str(caught.value)) - len(str(tmp_path)) < 260


def test_semicolons_of_spreadsheets(tmp_path):
    alignments = read_alignments_csv(write(tmp_path, ROW.replace(",", ";"), ROW.replace(",", ";")))
    assert alignments.scale.tolist() == [[0.5, 0.6, 0.7]] * 2


def test_only_the_first_row_may_be_a_header(tmp_path):
    header = "catid_cad,id_cad,tx,ty,tz,qw,qx,qy,qz,sx,sy,sz"
    with pytest.raises(DataError, match="line 2: tx is 'tx'"):
        read_alignments_csv(write(tmp_path, *[header] * 100))
