# SPDX-License-Identifier: Apache-2.0
"""A folder of results appears under its name whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from raytran.data.files import finished_folder
from raytran.errors import ConfigError


def check_replaceable(folder: Path, *, marker: str) -> None:
    """Raise unless ``folder`` is new, empty, or an earlier result, which it is when it holds ``marker``.

    Raises:
        ConfigError: something else is there, which must not be deleted.
    """
    if folder.is_dir() and ((folder / marker).is_file() or not any(folder.iterdir())):
        return
    if folder.exists():
        raise ConfigError(
            f"output={folder} holds something that is no earlier result (no {marker} in it): "
            "choose a folder that does not exist yet"
        )


@contextmanager
def replaced_folder(folder: Path, *, marker: str) -> Iterator[Path]:
    """Give a temporary sibling to fill, which then takes ``folder``'s name and place.

    If the block raises, the sibling is deleted and what was there before stays.

    Args:
        folder: the final name; parents are made.
        marker: a file that every result has and that tells an earlier result from anything else.

    Raises:
        ConfigError: ``folder`` holds something that is no earlier result.
    """
    folder = folder.resolve()
    check_replaceable(folder, marker=marker)
    with finished_folder(folder, replace=True) as fresh:
        yield fresh
