# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest

from raytran.errors import DataError
from raytran.viewer.scenes import find_scenes, shown_file


def make_scene(folder):
    (folder / "view" / "frames").mkdir(parents=True)
    for name in ("scene.json", "scene.glb", "view/view.json", "view/frames/0000.jpg", "secret.txt"):
        (folder / name).write_text(name)
    return folder


def test_one_result_or_many(tmp_path):
    room = make_scene(tmp_path / "a" / "room")
    other = make_scene(tmp_path / "b" / "deep" / "hall")
    make_scene(tmp_path / ".hidden")
    make_scene(room / "inside")
    assert find_scenes(room) == {"room": room}
    assert find_scenes(tmp_path) == {"a/room": room, "b/deep/hall": other}


def test_nothing_to_show(tmp_path):
    with pytest.raises(DataError, match=r"nowhere: give the output folder of `python -m raytran\.predict`"):
        find_scenes(tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"holds no scene\.json"):
        find_scenes(tmp_path)


@pytest.mark.parametrize("name", ["scene.json", "scene.glb", "view/view.json", "view/frames/0000.jpg"])
def test_what_a_page_needs(tmp_path, name):
    room = make_scene(tmp_path / "room")
    assert shown_file(room, name).read_text() == name


@pytest.mark.parametrize(
    "name",
    [
        *("", "view", "view/", "view/frames", "secret.txt", "view/none.jpg", "view/../secret.txt"),
        *(
            "view/../../outside.txt",
            "../outside.txt",
            "view//frames/0000.jpg",
            "view/./view.json",
            "/etc/passwd",
        ),
        *(
            "view//etc/passwd",
            "view/..\\..\\outside.txt",
            "view/\0",
            "view/" + "a" * 5000,
            "view/" + "a/" * 3000,
        ),
    ],
)
def test_nothing_else(tmp_path, name):
    room = make_scene(tmp_path / "room")
    (tmp_path / "outside.txt").write_text("outside")
    assert shown_file(room, name) is None


def test_links_are_followed_before_it_is_decided(tmp_path):
    room = make_scene(tmp_path / "room")
    (tmp_path / "outside.txt").write_text("outside")
    (room / "view" / "out.txt").symlink_to(tmp_path / "outside.txt")
    (room / "view" / "up").symlink_to(tmp_path, target_is_directory=True)
    (room / "view" / "loop").symlink_to(room / "view" / "loop")
    (room / "view" / "here.jpg").symlink_to(room / "view" / "frames" / "0000.jpg")
    (room / "scene.glb").unlink()
    (room / "scene.glb").symlink_to("/etc/passwd")
    for name in ("view/out.txt", "view/up/outside.txt", "view/loop", "scene.glb"):
        assert shown_file(room, name) is None, name
    assert shown_file(room, "view/here.jpg") is not None
