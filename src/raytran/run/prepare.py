# SPDX-License-Identifier: Apache-2.0
"""Write a data set to disk, or check one."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from raytran.data.cads.furniture import import_furniture
from raytran.data.prepare import PrepareSettings, Released, prepare_scan2cad
from raytran.data.rooms.generate import generate_rooms
from raytran.errors import ConfigError
from raytran.run.build import plain
from raytran.run.check import check

_log = logging.getLogger(__name__)

_ROOMS = (
    "num_train",
    "num_val",
    "seed",
    "frames",
    "image_size",
    "min_objects",
    "max_objects",
    "room_size",
    "processes",
)


def prepare(cfg: DictConfig) -> Any:
    """Run ``python -m raytran.prepare``; see ``conf/prepare.yaml``.

    Returns:
        The report of what was written, or with ``check`` whether nothing needs mending.

    Raises:
        ConfigError: the data set is unknown, or a path is missing.
        DataError: the input is missing or damaged, or ``output`` was begun with other settings.
    """
    if cfg.check is not None:
        return check(cfg)
    if cfg.dataset not in _DATASETS:
        raise ConfigError(f"unknown dataset={cfg.dataset}: choose one of {', '.join(_DATASETS)}")
    if cfg.output is None:
        raise ConfigError("output= is missing: give the folder to write to")
    return _DATASETS[cfg.dataset](plain(cfg), Path(cfg.output))


def _rooms(settings: dict[str, Any], output: Path) -> Any:
    chosen = {name: settings[name] for name in _ROOMS}
    report = generate_rooms(output, cads=_path(settings["cads"]), **chosen)
    _log.info("rooms are in %s; train on them with data.root=%s", output.resolve(), output)
    return report


def _scan2cad(settings: dict[str, Any], output: Path) -> Any:
    if settings["scannet"] is None:
        raise ConfigError("scannet= is missing: give the folder of ScanNet's scans")
    height, width = settings["image_size"]
    released = Released(
        scannet=Path(settings["scannet"]),
        shapenet=_path(settings["shapenet"]),
        scan2cad=_path(settings["scan2cad"]),
        scenes=settings["scenes"],
        splits=settings["splits"],
    )
    prepared = prepare_scan2cad(
        output,
        released,
        PrepareSettings((height, width), settings["max_frames"], settings["masks"]),
        grid_extent=tuple(settings["grid_extent"]),
        processes=settings["processes"],
    )
    _log.info("\n%s\nthe scans are in %s; train on them with", prepared.text, prepared.root)
    _log.info("python -m raytran.train data=scan2cad data.root=%s", output)
    return prepared


def _cads(settings: dict[str, Any], output: Path) -> Any:
    if settings["source"] is None:
        raise ConfigError("source= is missing: give the folder of the furniture libraries (*.sh3f)")
    report = import_furniture(Path(settings["source"]), output, processes=settings["processes"])
    _log.info("models are in %s; furnish rooms with them: dataset=rooms cads=%s", output.resolve(), output)
    return report


def _path(value: str | None) -> Path | None:
    return None if value is None else Path(value)


_DATASETS: dict[str, Callable[[dict[str, Any], Path], Any]] = {
    "rooms": _rooms,
    "scan2cad": _scan2cad,
    "cads": _cads,
}
"""Name of a data set → what writes it."""
