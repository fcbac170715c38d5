# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from raytran.data.prepare.report import PAPER_SCENES, PAPER_VAL_OBJECTS, gigabytes


def test_the_papers_counts():
    assert sum(PAPER_VAL_OBJECTS.values()) == 3184
    assert sum(PAPER_SCENES.values()) == 1500


def test_sizes():
    assert [gigabytes(n) for n in (0, 2_500_000, 3.21e9)] == ["0.0 MB", "2.5 MB", "3.2 GB"]


def test_text_has_the_counts_and_the_names(released, prepare, tmp_path):
    for n in range(7):
        folder = released / "scannet/scans" / f"scene01{n:02d}_00"
        folder.mkdir()
        for part in ("color", "pose", "intrinsic"):
            (folder / part).symlink_to(released / "scannet/scans/scene0000_00" / part)
    with (released / "scannet/scannetv2_train.txt").open("a") as file:
        file.writelines(f"scene01{n:02d}_00\n" for n in range(7))
    text = prepare(released, tmp_path / "out").text
    assert text == (tmp_path / "out" / "report.txt").read_text()
    assert "3 prepared: train 2 (paper 1194), val 1 (paper 306)" in text
    assert "Frames   9 written of 12\n         3 not taken because of max_frames\n" in text
    rows = {line.split()[0]: line.split()[1:] for line in text.splitlines() if line.startswith(" " * 9)}
    assert rows["chair"] == ["2", "1", "1093"]
    assert rows["all"] == ["2", "1", "3184"]
    assert "  scans without annotation: 7\n    scene0100_00, scene0101_00, " in text
    assert "scene0104_00, … and 2 more in" in text
    assert "scene0105_00" not in text
    assert "Noticed\n  nothing\n" in text
    assert max(map(len, text.splitlines())) <= 110


def test_text_says_why_a_scan_cannot_be_used(released, prepare, tmp_path):
    (released / "scannet/scans/scene0001_00/intrinsic/intrinsic_color.txt").unlink()
    text = prepare(released, tmp_path / "out").text
    (reason,) = [line for line in text.splitlines() if line.startswith("    scene0001_00: ")]
    assert "intrinsic_color.txt is missing" in reason
