# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest

from raytran.run.positional import name_positional


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        (["a/b.pt", "device=cpu"], ['file="a/b.pt"', "device=cpu"]),
        (["--cfg", "job", "x y"], ['file="x y"', "--cfg", "job"]),
        (["file=z.pt", "--help"], ["file=z.pt", "--help"]),
    ],
)
def test_words_without_a_key_get_one(typed, meant):
    assert name_positional(typed, "file") == meant


def test_several_make_a_list():
    assert name_positional(["a", "b", "output=c"], "runs", several=True) == ['runs=["a","b"]', "output=c"]
