# SPDX-License-Identifier: Apache-2.0
"""The classes of objects: the paper's, own ones, and what is none."""

from __future__ import annotations

import json
import pickle

import pytest

from raytran.classes import MAX_CLASSES, PAPER_CLASSES, Classes
from raytran.errors import ConfigError


def test_the_papers_classes_as_they_are_published() -> None:
    assert PAPER_CLASSES.names == (
        *("bathtub", "bookshelf", "cabinet", "chair", "display", "sofa", "table", "trashbin", "other"),
    )
    assert PAPER_CLASSES.label_of("03001627") == PAPER_CLASSES.index("chair") == 3
    assert PAPER_CLASSES.label_of("02818832") == PAPER_CLASSES.index("other") == 8
    assert PAPER_CLASSES.catids[7:] == (("02747177",), ())
    assert PAPER_CLASSES.hex(3) == "#1f77b4"


def test_own_classes_get_colours_that_can_be_told_apart() -> None:
    names = ["chair", *(f"machine {i}" for i in range(40))]
    classes = Classes.of({"names": names})
    assert classes.colors[0] == PAPER_CLASSES.colors[3]
    assert classes.colors == Classes.of({"names": names}).colors
    colors = [*classes.colors, *(c for c in PAPER_CLASSES.colors if c != classes.colors[0])]
    distances = [
        sum((a - b) ** 2 for a, b in zip(one, other, strict=True)) ** 0.5
        for i, one in enumerate(colors)
        for other in colors[:i]
    ]
    assert min(distances) > 30
    # The first of them lie further apart, and a given colour takes nobody else's place.
    assert Classes.of({"names": names, "colors": [[1, 2, 3], *[None] * 40]}).colors[1:] == classes.colors[1:]
    assert Classes.of({"names": ["a", "b"], "colors": [None, [1, 2, 3]]}).colors == (
        classes.colors[1],
        (1, 2, 3),
    )


def test_as_many_classes_as_there_can_be() -> None:
    classes = Classes.of({"names": [f"c{i}" for i in range(MAX_CLASSES)]})
    assert len(classes) == MAX_CLASSES
    assert all(0 <= part <= 255 for color in classes.colors for part in color)


@pytest.mark.parametrize(
    ("settings", "labels"),
    [
        # An annotation's category is one that a class lists, or the name of a class.
        ({"names": ["drill", "chair"]}, {"drill": 0, "03001627": 1, "chair": 1, "02818832": None}),
        ({"names": ["drill", "other"]}, {"drill": 0, "03001627": 1, "anything": 1}),
        ({"names": ["seat", "bed"], "catids": [["03001627", "02828884"], "02818832"]},
         {"03001627": 0, "02828884": 0, "02818832": 1, "seat": 0, "04379243": None}),
        # What another class lists is no longer that of the paper's class.
        ({"names": ["chair", "throne"], "catids": [None, "03001627"]}, {"03001627": 1, "chair": 0}),
    ],
)  # fmt: skip
def test_label_of_a_category(settings, labels) -> None:
    classes = Classes.of(settings)
    assert {category: classes.label_of(category) for category in labels} == labels


@pytest.mark.parametrize(
    "settings",
    [
        None,
        {
            "names": ["drill", "table", "lathe 2"],
            "colors": [[1, 2, 3], None, None],
            "catids": ["9", None, ["8"]],
        },
    ],
)
def test_classes_survive_a_file(settings) -> None:
    classes = Classes.of(settings)
    assert Classes.of(json.loads(json.dumps(classes.settings()))) == classes
    again = pickle.loads(pickle.dumps(classes))
    assert again == classes
    assert hash(again) == hash(classes)
    assert Classes.of(classes) is classes


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        (["drill"], "given by names"),
        ({"names": ["drill"], "colours": {}}, "given by names"),
        ({}, "got 0"),
        ({"names": "drill"}, "is no list"),
        ({"names": []}, "expected 1 to 500 classes, got 0"),
        ({"names": [f"c{i}" for i in range(MAX_CLASSES + 1)]}, "got 501"),
        ({"names": ["drill", "drill"]}, "'drill' is named twice"),
        ({"names": [True]}, "True is no text"),
        ({"names": [1]}, "1 is no text"),
        ({"names": [None]}, "None is no text"),
        ({"names": [["a"]]}, "is no text"),
        ({"names": [""]}, "printable characters"),
        ({"names": [" drill"]}, "printable characters"),
        ({"names": ["drill "]}, "printable characters"),
        ({"names": ["_drill"]}, "the first of them a letter"),
        ({"names": ["dr\nill"]}, "printable characters"),
        ({"names": ["d" * 61]}, "printable characters"),
        ({"names": ["drills/small"]}, "take one without"),
        ({"names": ["a${seed}"]}, "take one without"),
        ({"names": ["padding"]}, "not padding"),
        ({"names": ["drill"], "colors": {"drill": [1, 2, 3]}}, r"classes.colors=.* is no list"),
        ({"names": ["drill"], "colors": [[1, 2, 3], [1, 2, 3]]}, "colors has 2 entries for 1 names"),
        ({"names": ["drill"], "colors": [[1, 2, 300]]}, "from 0 to 255"),
        ({"names": ["drill"], "colors": [[1, 2]]}, "from 0 to 255"),
        ({"names": ["drill"], "colors": ["red"]}, "from 0 to 255"),
        ({"names": ["drill"], "colors": [[1.0, 2, 3]]}, "from 0 to 255"),
        ({"names": ["drill"], "colors": [[True, 2, 3]]}, "from 0 to 255"),
        ({"names": ["drill"], "catids": [3001627]}, "in quotes"),
        ({"names": ["drill"], "catids": [[3001627]]}, "in quotes"),
        ({"names": ["drill"], "catids": ["${oc.env:HOME}"]}, "in quotes"),
        ({"names": ["drill"], "catids": [None, None]}, "catids has 2 entries"),
        ({"names": ["a", "b"], "catids": ["1", ["1"]]}, "'1' is listed twice"),
        ({"names": ["chair", "table"], "catids": [["1", "1"], None]}, "'1' is listed twice"),
    ],
)  # fmt: skip
def test_what_is_no_list_of_classes_ends_in_a_sentence(settings, reason) -> None:
    with pytest.raises(ConfigError, match=reason):
        Classes.of(settings)


def test_a_class_that_is_not_there() -> None:
    with pytest.raises(ConfigError, match="'drill' is no class: choose one of bathtub, bookshelf"):
        PAPER_CLASSES.index("drill")


def test_as_many_colours_as_classes() -> None:
    with pytest.raises(ConfigError, match="colors has 1 entries for 2 names"):
        Classes(("a", "b"), colors=((1, 2, 3),))


def test_boxes_that_are_only_compared_may_have_any_words_for_classes() -> None:
    words = ("tv/monitor", "_misc", "$5 lamp", "x" * 100)
    assert Classes(words).names == words
    for settings in (Classes(words), {"names": list(words)}):
        with pytest.raises(ConfigError, match="cannot be the name of a class"):
            Classes.of(settings)
    with pytest.raises(ConfigError, match="printable"):
        Classes(("a\nb",))
