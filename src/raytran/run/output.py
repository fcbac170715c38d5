# SPDX-License-Identifier: Apache-2.0
"""A folder of results appears under its name whole or not at all, and one command at a time writes it."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from raytran.data.files import finished_folder
from raytran.data.locks import exclusive_lock
from raytran.errors import ConfigError

_LONGEST_NAME = 60


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
def one_writer(folder: Path, *, marker: str) -> Iterator[None]:
    """Keep other commands from writing a folder of results until the block ends or this process dies.

    Folders above it that are made for this, and are empty when the block raises, are removed.

    Args:
        folder: the final name; it need not exist.
        marker: see ``replaced_folder``.

    Raises:
        ConfigError: another process writes it, or it holds something that is no earlier result.
        DataError: the folder above cannot be written.
    """
    folder = folder.resolve()
    check_replaceable(folder, marker=marker)

    def taken(who: str) -> ConfigError:
        return ConfigError(f"another process writes {folder} ({who}): wait for it, or give another output=")

    # Beside the folder, which is replaced.
    name = folder.name
    if len(name) > _LONGEST_NAME:
        name = hashlib.sha256(name.encode(errors="surrogateescape")).hexdigest()
    new = [above for above in folder.parents if not above.exists()]
    try:
        with exclusive_lock(folder.with_name(f".{name}.lock"), if_taken=taken):
            yield
    except BaseException:
        with contextlib.suppress(OSError):  # the first that holds something ends it
            for above in new:
                above.rmdir()
        raise


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
