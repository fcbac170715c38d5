# SPDX-License-Identifier: Apache-2.0
"""The command ``poses``: from a video without poses to a scan that ``predict`` reads."""

from __future__ import annotations

import logging
import shlex
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import Progress, TaskID

from raytran.capture.lens import load_pycolmap
from raytran.capture.orientation import measured_up, rotation_to_z
from raytran.capture.poses.film import Film, open_film
from raytran.capture.poses.floor import Floor, find_floor, level_by_floor
from raytran.capture.poses.mapping import FEWEST, MATCHINGS, FoundCameras, find_cameras
from raytran.capture.poses.scene import IMAGES, LISTED, write_images, write_scene
from raytran.capture.poses.sharp import choose_sharp
from raytran.capture.poses.unit import unit_by_distance, unit_by_height
from raytran.data.files import SettingsRecord, write_json
from raytran.data.locks import exclusive_lock
from raytran.data.text import read_json_object
from raytran.errors import ConfigError, DataError
from raytran.run.train.build import plain

_log = logging.getLogger(__name__)

SCANS = Path("outputs") / "scans"
"""Where scans go if nothing else is said, each by the name of its film."""

SUPPOSED_HEIGHT = 1.5
"""Metres above the floor at which a phone is held, where nobody says: before the face of who films."""

_WORK, _RECORD, _CHOSEN = "work", "film.json", "frames.json"
_MEASURES = ("camera_height", "distance", "scale")
_GOOD_SHARE = 0.7
"""Share of the frames in the model below which the film is said to be doubtful."""


def poses(cfg: DictConfig) -> Path:
    """Run ``raytran poses``; see ``conf/poses.yaml``.

    Returns:
        The folder of the scan.

    Raises:
        ConfigError: a setting is unknown, a package is missing, or ``output`` is of another film.
        DataError: the video cannot be read, or its cameras cannot be found.
    """
    settings = plain(cfg)
    _check(settings)
    load_pycolmap("the cameras of a film are found")
    video = Path(settings["video"]).resolve()
    typed = Path(settings["output"]) if settings["output"] else SCANS / video.stem
    output = typed.resolve()

    def taken(who: str) -> ConfigError:
        return ConfigError(f"another process writes {output} ({who}): wait for it, or give another output=")

    with closing(open_film(video)) as film:
        if not (output / _WORK / _RECORD).is_file() and output.is_dir() and any(output.iterdir()):
            raise ConfigError(
                f"output={output} holds something else: choose a folder that does not exist yet"
            )
        (output / _WORK).mkdir(parents=True, exist_ok=True)
        with exclusive_lock(output / _WORK / ".lock", if_taken=taken):
            _begin(film, settings, output / _WORK / _RECORD)
            _find(film, settings, output)
    _log.info("next: raytran predict %s", shlex.quote(str(typed)))
    return output


def _check(settings: dict[str, Any]) -> None:
    """Raise if a setting makes no sense.

    Raises:
        ConfigError: one does not.
    """
    if settings["matching"] not in MATCHINGS:
        raise ConfigError(f"unknown matching={settings['matching']}: choose one of {', '.join(MATCHINGS)}")
    if settings["frames"] < FEWEST:
        raise ConfigError(f"frames={settings['frames']} is too few: give {FEWEST} or more, 100 are better")
    given = [name for name in _MEASURES if settings[name] is not None]
    if len(given) > 1:
        raise ConfigError(
            f"{' and '.join(f'{name}=' for name in given)} tell the unit twice: give one of them"
        )
    if (settings["distance"] is None) != (settings["marks"] is None):
        raise ConfigError(
            "distance= and marks= belong together: give the metres and the two points, or neither"
        )
    for name in given:
        if not settings[name] > 0:
            raise ConfigError(f"{name}={settings[name]} is no length: give metres above 0")


def _begin(film: Film, settings: dict[str, Any], path: Path) -> None:
    """Raise if the folder was begun with another film or other frames of it.

    Raises:
        ConfigError: it was.
    """
    wanted = {
        "film": film.path.name,
        "num_frames": len(film),
        "bytes": film.path.stat().st_size if film.path.is_file() else None,
        "frames": settings["frames"],
        "longest_side": settings["longest_side"],
    }
    others = SettingsRecord(path).begin(wanted)
    if others:
        raise ConfigError(
            f"output={path.parent.parent} was begun with another {' and '.join(others)}: give another "
            "output=, or delete it"
        )


def _find(film: Film, settings: dict[str, Any], output: Path) -> None:
    """Choose frames, find their cameras, and write the scan."""
    with _bars() as bars:
        names = _chosen(film, settings, output, bars)
        found = find_cameras(
            output / IMAGES, names, output / _WORK, matching=settings["matching"], progress=bars.report
        )
    _report_cameras(found)
    turn, is_level = _upright(found)
    cameras = found.world_from_camera[:, :3, 3] @ turn.T
    floor = find_floor(found.points @ turn.T, cameras)
    scale, how, is_metric = _unit(settings, found, floor, cameras)
    world_from_model = np.eye(4)
    world_from_model[:3, :3] = scale * turn
    if floor is not None:
        world_from_model[2, 3] = -scale * floor.height
    write_scene(
        output,
        found,
        world_from_model,
        is_level=is_level,
        is_metric=is_metric,
        made_from={"scale": scale, "unit_by": how, "film": film.path.name},
    )
    heights = scale * cameras[:, 2]
    span = np.ptp(scale * cameras, axis=0)
    _log.info(
        "unit: %s; the cameras' path spans %.1f x %.1f m and rises and falls by %.1f m%s",
        *(how, span[0], span[1], span[2]),
        "" if floor is None else f", {float(heights.mean()) - scale * floor.height:.2f} m above the floor",
    )
    _log.info("wrote %s and %s of %d frames", output / LISTED, IMAGES, len(found.names))


def _chosen(film: Film, settings: dict[str, Any], output: Path, bars: _Bars) -> list[str]:
    """Return the names of the images, after choosing and writing them."""
    path = output / _WORK / _CHOSEN
    if path.is_file():
        frames = read_json_object(path).get("frames")
        known = range(len(film))
        if not isinstance(frames, list) or not all(type(frame) is int and frame in known for frame in frames):
            raise DataError(f"{path} is damaged: delete {output / _WORK} and give the command again")
    else:
        choice = choose_sharp(film, settings["frames"], progress=bars.track("looking for sharp frames"))
        frames = list(choice.frames)
        _log.info(
            "%s: chose %d of %d frames for their sharpness; left out %d stretches that are blurred",
            *(film.path.name, len(frames), len(film), choice.num_blurred),
        )
        if choice.num_damaged:
            _log.warning("%s: %d frames cannot be read", film.path.name, choice.num_damaged)
        write_json(path, {"frames": frames})
    if len(frames) < FEWEST:
        raise DataError(
            f"{film.path} has only {len(frames)} frames to match: film for half a minute, all around the room"
        )
    images = output / IMAGES
    return write_images(film, frames, images, settings["longest_side"], progress=bars.track("writing frames"))


def _report_cameras(found: FoundCameras) -> None:
    placed = f"{len(found.names)} of {found.num_frames} frames ({found.share:.0%})"
    detail = (
        f"focal length {found.focal:.0f} px, {len(found.points)} points, {found.error:.2f} px off in the mean"
    )
    if found.share >= _GOOD_SHARE:
        _log.info("placed %s: %s", placed, detail)
    else:
        _log.warning(
            "placed only %s: %s; the others show a part of the room that does not hang together with it: "
            "film slower, with more light, and end where you began",
            *(placed, detail),
        )


def _upright(found: FoundCameras) -> tuple[NDArray[np.float64], bool]:
    """Return the rotation ``(3, 3)`` that takes up in the model to +z, and whether it is certain."""
    measured = measured_up(found.world_from_camera)
    if measured is None:
        _log.warning(
            "up cannot be told, for the phone was turned in all ways: give up= to predict, or hold it level"
        )
        return np.eye(3), False
    up = measured.direction
    if measured.is_level:
        up = level_by_floor(up, found.points, found.world_from_camera[:, :3, 3])
        by = "the cameras" if up is measured.direction else "the floor"
        _log.info("up: measured from %s, certain", by)
    else:
        _log.warning("up: unsure, for the cameras look one way; film all sides of the room")
    return rotation_to_z(up), measured.is_level


def _unit(
    settings: dict[str, Any], found: FoundCameras, floor: Floor | None, cameras: NDArray[np.float64]
) -> tuple[float, str, bool]:
    """Return the metres in a unit of the model, how they were found, and whether they were measured."""
    if settings["scale"] is not None:
        return float(settings["scale"]), "as scale= says", True
    if settings["distance"] is not None:
        scale = unit_by_distance(found, settings["distance"], settings["marks"])
        return scale, f"two points {settings['distance']:g} m apart", True
    if settings["camera_height"] is not None:
        scale = unit_by_height(floor, cameras, settings["camera_height"])
        return scale, f"the phone {settings['camera_height']:g} m above the floor", True
    if floor is None:
        _log.warning(
            "the unit is not known, and no floor is found: everything predicted will be of a wrong size; "
            "give distance= and marks= to this command, it takes seconds now"
        )
        return 1.0, "not known", False
    _log.warning(
        "the unit is supposed, by a phone %g m above the floor: measure that and give camera_height=, or "
        "give distance= and marks=, to this command; it takes seconds now",
        SUPPOSED_HEIGHT,
    )
    scale = unit_by_height(floor, cameras, SUPPOSED_HEIGHT)
    return scale, f"supposed, the phone {SUPPOSED_HEIGHT:g} m above the floor", False


@dataclass
class _Bars:
    """Progress on the screen: a bar for each kind of work in a terminal, a line for each elsewhere."""

    progress: Progress
    is_shown: bool
    what: str = ""
    task: TaskID | None = None

    def report(self, what: str, done: int, total: int | None) -> None:
        """Say how much of some work is done."""
        if what != self.what:
            if not self.is_shown:
                _log.info("%s%s", what, "" if total is None else f" ({total})")
            self.what, self.task = what, self.progress.add_task(what, total=total)
        if self.task is not None:
            self.progress.update(self.task, completed=done, total=total)

    def track(self, what: str) -> Any:
        """Return a function that yields what it is given and reports each."""

        def yielded(items: Iterable[int], total: int) -> Iterator[int]:
            for number, item in enumerate(items):
                self.report(what, number, total)
                yield item
            self.report(what, total, total)

        return yielded


@contextmanager
def _bars() -> Iterator[_Bars]:
    console = Console()
    with Progress(console=console, disable=not console.is_terminal, transient=True) as progress:
        yield _Bars(progress, console.is_terminal)
