# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import math

import pytest

from raytran.data.prepare.annotation import (
    DEGENERATE,
    find_annotations,
    read_usable,
    used_models,
    without_models,
)
from raytran.errors import DataError


def test_a_file_without_faults_comes_as_it_is(write_annotations, cube_entry):
    path = write_annotations({"a": [cube_entry(), cube_entry(id_cad="other")], "b": []})
    found = read_usable(path)
    assert found.entries == {"a": json.loads(path.read_text())[0]}
    assert (found.empty, found.left_out, found.twice) == (["b"], [], [])
    assert used_models(found.entries.values()) == ["03001627/cube", "03001627/other"]


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"scale": (1, 1e-9, 1)}, DEGENERATE),
        ({"bbox": [0.0, 0.0, 1.0]}, DEGENERATE),
        ({"translation": (math.inf, 0, 0)}, "translation holds inf"),
        ({"bbox": [1, 2]}, "bbox does not hold 1x3 numbers"),
        ({"bbox": [1, 1, 1e300]}, "bbox holds 1e+300"),
        ({"bbox": "abc"}, "bbox does not hold"),
        ({"trs": []}, "where an object belongs"),
        (
            {
                "trs": {"rotation": [1, 0, 0, 0], "translation": [0] * 3, "scale": [1e3] * 3},
                "bbox": [1e3] * 3,
            },
            "kilometres",
        ),
        ({"id_cad": ["a"] * 10**5}, "['a', 'a', 'a'"),
        ({"sym": None}, "unknown symmetry"),
        ({"id_cad": "a/b"}, "other characters"),
        ({"catid_cad": 3001627}, "other characters"),
        ({"trs": {"rotation": [0, 0, 0, 0], "translation": [0] * 3, "scale": [1] * 3}}, "length zero"),
    ],
)
def test_a_model_that_cannot_be_used_is_left_out_alone(write_annotations, cube_entry, fields, reason):
    found = read_usable(write_annotations({"a": [cube_entry(**fields), cube_entry()]}))
    (left_out,) = found.left_out
    assert left_out.scan == "a"
    assert reason in left_out.reason
    assert found.entries["a"]["aligned_models"] == [cube_entry()]
    assert found.entries["a"]["n_aligned_models"] == 1


def test_a_flat_sheet_is_an_object(write_annotations, cube_entry):
    assert "a" in read_usable(write_annotations({"a": [cube_entry(bbox=[0.5, 0.5, 0.0])]})).entries


def test_entries_that_are_damaged_or_come_twice_are_named(write_annotations, cube_entry):
    path = write_annotations({"a": [cube_entry()], "../b": [cube_entry()], "c": [cube_entry(sym="x")]})
    entries = json.loads(path.read_text())
    path.write_text(json.dumps([*entries, entries[0], {"id_scan": "d"}, 5]))
    found = read_usable(path)
    assert list(found.entries) == ["a"]
    assert found.twice == ["a"]
    assert [(part.scan, part.model) for part in found.left_out] == [
        ("../b", ""),
        ("c", "03001627/cube"),
        ("d", ""),
        ("entry 5", ""),
    ]


def test_models_without_cad_are_taken_out_each_time_they_occur(write_annotations, cube_entry):
    models = [cube_entry(id_cad="gone"), cube_entry(), cube_entry(id_cad="gone")]
    entry = read_usable(write_annotations({"a": models})).entries["a"]
    rest, left_out = without_models(entry, {"03001627/gone": "no CAD file"})
    assert rest["aligned_models"] == [models[1]]
    assert [part.model for part in left_out] == ["03001627/gone"] * 2
    assert entry["n_aligned_models"] == 3


def test_the_file_is_found_in_folders(write_annotations, tmp_path):
    path = write_annotations({}, tmp_path / "x")
    for given in (path, path.parent, tmp_path / "x", tmp_path):
        assert find_annotations(given) == path
    write_annotations({}, tmp_path / "y")
    with pytest.raises(DataError, match="several files"):
        find_annotations(tmp_path)
    with pytest.raises(DataError, match="no file"):
        find_annotations(tmp_path / "nothing")
