# SPDX-License-Identifier: Apache-2.0
"""Files and folders typed without a key, as people expect of a command that reads them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from raytran.run.entry import quoted

_WITH_VALUE = {
    "--cfg",
    "-c",
    "--config-dir",
    "-cd",
    "--config-path",
    "-cp",
    "--config-name",
    "-cn",
    "--info",
    "-i",
}
"""Hydra's options that a word of their own may follow."""


def name_positional(words: Sequence[str], key: str, *, several: bool = False) -> list[str]:
    """Return the words of a command line with those that are neither settings nor options given to ``key``.

    Args:
        words: as typed.
        key: setting that they mean.
        several: it takes a list of them.
    """
    given: list[str] = []
    others: list[str] = []
    before = ""
    for word in words:
        is_place = "=" not in word and not word.startswith("-") and before not in _WITH_VALUE
        (given if is_place else others).append(word)
        before = word
    if not given:
        return others
    paths = ",".join(quoted(Path(word)) for word in given)
    return [f"{key}=[{paths}]" if several else f"{key}={paths}", *others]
