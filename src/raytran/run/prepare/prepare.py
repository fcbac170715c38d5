# SPDX-License-Identifier: Apache-2.0
"""The command ``prepare``: write a data set to disk, or check one."""

from __future__ import annotations

import logging
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from raytran.capture.boxes.arkitscenes import find_arkitscenes
from raytran.capture.boxes.captures import find_captures
from raytran.capture.boxes.categories import Categories
from raytran.classes import PAPER_CLASSES, Classes
from raytran.data.prepare import PrepareSettings, Released, prepare_scan2cad
from raytran.data.prepare.boxed_scan import AnnotatedSource
from raytran.data.prepare.prepare_boxes import prepare_boxes
from raytran.errors import ConfigError
from raytran.rooms.benchmark import generate_rooms_v1, generate_rooms_v1_furniture
from raytran.rooms.generate import generate_rooms
from raytran.rooms.report import report_on_rooms
from raytran.rooms.rooms_v2 import generate_rooms_v2
from raytran.rooms.sweethome3d.furniture import import_furniture
from raytran.run.config_dir import config_dir
from raytran.run.prepare.check import check
from raytran.run.train.build import plain

_log = logging.getLogger(__name__)

DATASETS = ("rooms", "rooms-v1", "rooms-v1-furniture", "rooms-v2", "scan2cad", "boxes", "arkitscenes", "cads")

_COUNTS = ("num_train", "num_val", "num_test")
_FREE_ONLY = ("seed", "frames", "image_size", "min_objects", "max_objects", "room_size")
"""Settings that dataset=rooms alone has; rooms-v1 and rooms-v2 fix them."""

_FIXED = "rooms-v1 and rooms-v2 are the same for everybody; dataset=rooms makes rooms of your choice"

_PART = "it is of the test rooms of dataset=rooms-v1-furniture; training rooms never get what is held out"


def prepare(cfg: DictConfig) -> Any:
    """Run ``raytran prepare``; see ``conf/prepare.yaml``.

    Returns:
        The report of what was written, or with ``check`` whether nothing needs mending.

    Raises:
        ConfigError: the data set is unknown, or a path is missing.
        DataError: the input is missing or damaged, or ``output`` was begun with other settings.
    """
    if cfg.check is not None:
        return check(cfg)
    if cfg.dataset not in DATASETS:
        raise ConfigError(f"unknown dataset={cfg.dataset}: choose one of {', '.join(DATASETS)}")
    if cfg.output is None:
        raise ConfigError("output= is missing: give the folder to write to")
    settings, output = plain(cfg), Path(cfg.output)
    if cfg.dataset == "rooms":
        return _prepare_rooms(settings, output)
    if cfg.dataset == "rooms-v1":
        return _prepare_rooms_v1(settings, output)
    if cfg.dataset == "rooms-v1-furniture":
        return _prepare_rooms_v1_furniture(settings, output)
    if cfg.dataset == "rooms-v2":
        return _prepare_rooms_v2(settings, output)
    if cfg.dataset == "scan2cad":
        return _prepare_scan2cad(settings, output)
    if cfg.dataset == "boxes":
        return _prepare_captures(settings, output)
    if cfg.dataset == "arkitscenes":
        return _prepare_arkitscenes(settings, output)
    return _prepare_cads(settings, output)


def _data_root(folder: Path) -> str:
    """Return the setting of a command that reads a data set, as one types it into a shell."""
    return shlex.quote(f"data.root={folder}")


def _prepare_rooms(settings: dict[str, Any], output: Path) -> Any:
    _refuse(settings, "num_test", because="dataset=rooms has no test rooms, dataset=rooms-v1 has")
    _refuse(settings, "part", because=_PART)
    settings = _with_preset(settings)
    report = generate_rooms(
        output,
        cads=_path(settings["cads"]),
        processes=settings["processes"],
        **{name: settings[name] for name in ("num_train", "num_val", *_FREE_ONLY)},
    )
    _log.info("rooms are in %s; train on them with %s", output.resolve(), _data_root(output))
    return report


def _prepare_rooms_v1(settings: dict[str, Any], output: Path) -> Any:
    _refuse(settings, *_FREE_ONLY, because=_FIXED)
    _refuse(settings, "cads", because="given CAD models go with dataset=rooms-v1-furniture")
    _refuse(settings, "part", because=_PART)
    report = generate_rooms_v1(output, processes=settings["processes"], **_given(settings, *_COUNTS))
    _log.info("%s\nthe rooms are in %s", report_on_rooms(report.root), report.root)
    _log.info("train on them with data=rooms-v1 %s, then evaluate … split=test", _data_root(output))
    return report


def _prepare_rooms_v1_furniture(settings: dict[str, Any], output: Path) -> Any:
    _refuse(settings, *_FREE_ONLY, because=_FIXED)
    _refuse(settings, "num_train", "num_val", because="rooms-v1-furniture has test rooms only")
    if settings["cads"] is None:
        raise ConfigError("cads= is missing: give the folder that prepare dataset=cads wrote")
    chosen = _given(settings, "num_test", "part")
    report = generate_rooms_v1_furniture(
        output, cads=Path(settings["cads"]), processes=settings["processes"], **chosen
    )
    _log.info("%s\nthe rooms are in %s; evaluate on them with", report_on_rooms(report.root), report.root)
    _log.info("raytran evaluate checkpoint=CKPT data=scan2cad %s split=test", _data_root(output))
    return report


def _prepare_rooms_v2(settings: dict[str, Any], output: Path) -> Any:
    _refuse(settings, *_FREE_ONLY, because=_FIXED)
    _refuse(settings, "num_test", because="rooms-v2 has no test rooms, rooms-v1 has")
    _refuse(settings, "part", because=_PART)
    report = generate_rooms_v2(
        output,
        cads=_path(settings["cads"]),
        processes=settings["processes"],
        **_given(settings, "num_train", "num_val"),
    )
    _log.info("%s\nthe rooms are in %s", report_on_rooms(report.root), report.root)
    _log.info("train on them with data=rooms-v2 %s", _data_root(output))
    return report


def _prepare_scan2cad(settings: dict[str, Any], output: Path) -> Any:
    if settings["scannet"] is None:
        raise ConfigError("scannet= is missing: give the folder of ScanNet's scans")
    height, width = _with_preset(settings)["image_size"]
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
    _log.info("raytran train data=scan2cad %s", _data_root(output))
    return prepared


def _prepare_captures(settings: dict[str, Any], output: Path) -> Any:
    if settings["captures"] is None:
        raise ConfigError("captures= is missing: give the folder with a folder or video for each capture")
    found = find_captures(Path(settings["captures"]), _categories(settings), boxes=_path(settings["boxes"]))
    seed = settings["seed"] if settings["seed"] is not None else 0
    return _prepare_boxes(
        settings, output, found.sources, found.left_out, val_share=settings["val_share"], seed=seed
    )


def _prepare_arkitscenes(settings: dict[str, Any], output: Path) -> Any:
    if settings["arkitscenes"] is None:
        raise ConfigError("arkitscenes= is missing: give the folder with 3dod/Training and 3dod/Validation")
    found = find_arkitscenes(
        Path(settings["arkitscenes"]),
        # Labels that no class has, of which there are some, are left out as in the data set's own scripts.
        _categories(settings, unknown_left_out=True),
        scenes=settings["scenes"],
        splits=settings["splits"],
    )
    return _prepare_boxes(settings, output, found.sources, found.left_out)


def _prepare_boxes(
    settings: dict[str, Any],
    output: Path,
    sources: Sequence[AnnotatedSource],
    left_out: Mapping[str, Any],
    **splits: Any,
) -> Any:
    """Prepare scans with boxes, and say how to train on them."""
    height, width = _with_preset(settings)["image_size"]
    prepared = prepare_boxes(
        output,
        sources,
        PrepareSettings((height, width), settings["max_frames"], settings["masks"]),
        left_out=left_out,
        processes=settings["processes"],
        **splits,
    )
    _log.info("\n%s\nthe scans are in %s; train on them with", prepared.text, prepared.root)
    data = settings["dataset"]  # each has the configuration of its name
    _log.info("raytran train data=%s %s%s", data, _data_root(output), _classes_as_typed(settings))
    return prepared


def _categories(settings: dict[str, Any], *, unknown_left_out: bool = False) -> Categories:
    return Categories(
        Classes.of(settings["classes"]), settings["categories"] or {}, unknown_left_out=unknown_left_out
    )


def _classes_as_typed(settings: dict[str, Any]) -> str:
    """Return the setting that names these classes to another command; nothing for the paper's."""
    names = Classes.of(settings["classes"]).names
    if names == PAPER_CLASSES.names:
        return ""
    for path in sorted((config_dir() / "classes").glob("*.yaml")):
        if Classes.of(plain(OmegaConf.load(path))).names == names:
            return f" classes={path.stem}"
    return " " + shlex.quote(f"classes.names=[{','.join(names)}]")


def _prepare_cads(settings: dict[str, Any], output: Path) -> Any:
    if settings["source"] is None:
        raise ConfigError("source= is missing: give the folder of the furniture libraries (*.sh3f)")
    report = import_furniture(Path(settings["source"]), output, processes=settings["processes"])
    _log.info("models are in %s; furnish rooms with them: dataset=rooms cads=%s", output.resolve(), output)
    return report


def _refuse(settings: dict[str, Any], *names: str, because: str) -> None:
    """Raise if one of these settings was given.

    Raises:
        ConfigError: one was.
    """
    given = _given(settings, *names)
    if given:
        raise ConfigError(f"leave out {', '.join(f'{name}=' for name in given)}: {because}")


def _given(settings: dict[str, Any], *names: str) -> dict[str, Any]:
    """Return those of the named settings that are not null."""
    return {name: settings[name] for name in names if settings[name] is not None}


def _with_preset(settings: dict[str, Any]) -> dict[str, Any]:
    """Return the settings; those of rooms that are null are the preset's."""
    return settings | {name: value for name, value in settings["rooms"].items() if settings[name] is None}


def _path(value: str | None) -> Path | None:
    return None if value is None else Path(value)
