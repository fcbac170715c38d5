# SPDX-License-Identifier: Apache-2.0
"""Text, tables and JSON that anybody may have written."""

from __future__ import annotations

import os
import threading

import numpy as np
import pytest

from raytran.data.text import as_name, read_json, read_json_object, read_names, read_table, read_text
from raytran.errors import DataError

TEXT = "1, 2.5;-3e1\r\n# a note\r\n\r\n4 5 6 # ü\r\n"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_every_encoding_of_a_table_gives_the_same_numbers(tmp_path, encoding):
    path = tmp_path / "table.txt"
    path.write_bytes(TEXT.encode(encoding))
    np.testing.assert_array_equal(read_table(path), [[1, 2.5, -30], [4, 5, 6]])


@pytest.mark.parametrize(("lines", "number"), [("1 2\n3\n", 2), ("1 2\n\n3 x\n", 3), ("a b\n1 2\n", 1)])
def test_table_with_another_line_names_it(tmp_path, lines, number):
    (tmp_path / "table.txt").write_text(lines)
    with pytest.raises(DataError, match=f"line {number} of .*table.txt does not hold numbers"):
        read_table(tmp_path / "table.txt")


def test_files_that_are_no_text_end_in_a_sentence(tmp_path):
    path = tmp_path / "file"
    with pytest.raises(DataError, match=r"cannot read .*file"):
        read_text(path)
    with pytest.raises(DataError, match="cannot read"):
        read_text(tmp_path)
    path.write_bytes(b"\xff\xd8\xff\xe0JFIF\xd8")
    with pytest.raises(DataError, match="no text in UTF-8"):
        read_text(path)
    path.write_bytes(b"x" * 101)
    with pytest.raises(DataError, match="larger than"):
        read_text(path, max_bytes=100)
    assert len(read_text(path, max_bytes=101)) == 101


def test_a_file_without_end_is_not_read_for_ever(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    writer = threading.Thread(target=lambda: (tmp_path / "pipe").write_bytes(b"0 " * 60), daemon=True)
    writer.start()
    with pytest.raises(DataError, match="larger than"):
        read_text(tmp_path / "pipe", max_bytes=100)
    writer.join()


def test_huge_whole_numbers_are_floats(tmp_path):
    path = tmp_path / "numbers.json"
    path.write_text(f"[12, {'9' * 18}, {'9' * 400}, -{'9' * 70_000}, 1e999]")
    assert read_json(path) == [12, 10**18 - 1, float("inf"), -float("inf"), float("inf")]


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000, "{'a': 1}", '"\\ud800"', '{"\\uDFFF": 1}', "\x00"])
def test_what_is_no_json_ends_in_one_short_sentence(tmp_path, text):
    path = tmp_path / "file.json"
    path.write_text(text)
    with pytest.raises(DataError, match=r"no valid JSON|no Unicode") as error:
        read_json(path)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 300 + len(str(path))


def test_pairs_of_escaped_halves_are_text(tmp_path):
    (tmp_path / "file.json").write_text('{"name": "\\ud83d\\ude00"}')
    assert read_json_object(tmp_path / "file.json") == {"name": "😀"}
    (tmp_path / "file.json").write_text("[1]")
    with pytest.raises(DataError, match="holds a list, not a JSON object"):
        read_json_object(tmp_path / "file.json")


@pytest.mark.parametrize("text", ["[{}" + ",{}" * 2_700_000 + "]", "[" + "[]," * 4_000_000 + "1]"])
def test_json_of_millions_of_values_is_not_built(tmp_path, text):
    (tmp_path / "file.json").write_text(text)
    with pytest.raises(DataError, match="holds more than 8,000,000 values"):
        read_json(tmp_path / "file.json")


def test_a_key_that_comes_twice_is_named(tmp_path):
    (tmp_path / "file.json").write_text('{"a": {"fx": 1, "fy": 2, "fx": 3}}')
    with pytest.raises(DataError, match="the key 'fx' comes twice"):
        read_json(tmp_path / "file.json")


def test_names_are_short_and_printable(tmp_path):
    (tmp_path / "names.txt").write_text("scene0000_00\n\nscene0001_00 ü\n")
    assert read_names(tmp_path / "names.txt") == ["scene0000_00", "scene0001_00", "ü"]
    for value in ("", "x" * 201, "a\nb", "\x1b[2J", 5, None, ["a"], "\ud800"):
        with pytest.raises(DataError, match="no name of at most 200 characters") as error:
            as_name(value, "id_scan")
        assert str(error.value).isprintable()
