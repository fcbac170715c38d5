# SPDX-License-Identifier: Apache-2.0
"""Cameras of a film's frames by structure from motion: pycolmap's features, matches and incremental mapper.

The global mapper is not used: it places every frame, those that it places wrongly among them. Of a real walk
whose frames have little in common the incremental one left out two thirds, and the global one was metres off.

Everything is kept in a work folder, so that a command that was stopped goes on: features and matches in
``database.db``, a finished model for each way of mapping in ``models/``.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from raytran.capture.lens import load_pycolmap
from raytran.data.files import finished_folder, write_text
from raytran.errors import DataError

_log = logging.getLogger(__name__)

MATCHINGS = ("auto", "sequential", "exhaustive")

CAMERA_MODEL = "SIMPLE_RADIAL"
"""One focal length and one coefficient of distortion: phones correct most of theirs, and of more the few
frames of a room may tell nonsense."""

_FOCAL_FACTOR = 0.85
"""First guess of the focal length in parts of the longer side, as of a phone's main camera filming; it is
refined."""

_MAX_FEATURES = 4096
_OVERLAP = 10
"""Each frame is matched with so many after it, and with those 2, 4, 8, … times farther away."""

_LEAST_SHARE = 0.8
"""Share of the frames in the largest model below which ``auto`` matches all pairs, too."""

_MOST_PAIRED = 400
"""Frames up to which it does: with all pairs the time grows by the square."""

FEWEST = 8
"""Frames that a model must have."""

_SEED = 0
_LITTLE_TEXTURE = 150
"""Features of the median frame below which the film shows too little to be matched."""

_FEW_NEIGHBOURS = 0.5
"""Share of the pairs of neighbours that match below which the film is too fast or too blurred."""

_TURNED = 0.5
"""Share of the matched neighbours between which the camera only turned from which that is the reason."""

_PANORAMAS = ("PANORAMIC", "PLANAR_OR_PANORAMIC")
"""Of ``TwoViewGeometryConfiguration``: pairs of images that one homography explains."""

_BATCH = 16
"""Images between two reports of progress; so much is lost, at most, when the command is stopped."""

Progress = Callable[[str, int, int | None], None]
"""Told what is at work, how much of it is done, and how much there is; None if that is not known."""

_EVERY = 0.5
"""Seconds between two reports."""


@dataclass(frozen=True)
class FoundCameras:
    """A model: the frames that were registered, their common lens, and points.

    Attributes:
        names: file names of the frames, in the order of the film.
        world_from_camera: ``(n, 4, 4)`` float64, OpenCV axes; any world, any unit.
        image_size: ``(H, W)``.
        focal: pixels.
        center: principal point (cx, cy), pixels.
        distortion: first radial coefficient.
        points: ``(p, 3)`` float64, of the scene.
        num_frames: frames that were to be registered.
        num_models: models that do not hang together, of which this is the largest.
        error: mean distance between points and where they were seen, pixels.
    """

    names: tuple[str, ...]
    world_from_camera: NDArray[np.float64]
    image_size: tuple[int, int]
    focal: float
    center: tuple[float, float]
    distortion: float
    points: NDArray[np.float64]
    num_frames: int
    num_models: int
    error: float

    @property
    def share(self) -> float:
        """Part of the frames that was registered."""
        return len(self.names) / self.num_frames


def find_cameras(
    images: Path,
    names: list[str],
    work: Path,
    *,
    matching: str = "auto",
    progress: Progress | None = None,
) -> FoundCameras:
    """Find the cameras of images that one camera took, one after the other.

    Args:
        images: their folder.
        names: file names in the order of the film.
        work: folder that keeps what was computed; empty at first, later only for the same images.
        matching: ``sequential``: neighbours and some farther frames; ``exhaustive``: all pairs; ``auto``: the
            first, and the second if it leaves out more than a fifth.
        progress: told how far it is.

    Raises:
        ConfigError: pycolmap is not installed.
        DataError: fewer than ``FEWEST`` frames can be registered together; the sentence has the reason.
    """
    pycolmap = load_pycolmap("cameras are found")
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    work.mkdir(parents=True, exist_ok=True)
    tell = progress or (lambda what, done, total: None)
    database = _Database(pycolmap, work / "database.db")
    _extract(pycolmap, database, images, names, tell)
    found: FoundCameras | None = None
    for kind in ("sequential", "exhaustive") if matching == "auto" else (matching,):
        if found is not None and (found.share >= _LEAST_SHARE or len(names) > _MOST_PAIRED):
            break
        models = work / "models" / kind
        if found is not None and not models.is_dir():
            _log.info("%d of %d frames fit together: all pairs are matched now", len(found.names), len(names))
        if not models.is_dir():
            _match(pycolmap, database, pairs_to_match(names, kind), work / "pairs.txt", tell)
            _map(pycolmap, database, images, models, len(names), tell)
        now = _largest(pycolmap, models, names)
        if found is None or len(now.names) >= len(found.names):
            found = now
    if found is None or len(found.names) < FEWEST:
        raise _too_few(database, 0 if found is None else len(found.names), names)
    return found


class _Database:
    """COLMAP's database, read through pycolmap: another SQLite in this process would take its locks away."""

    def __init__(self, pycolmap: Any, path: Path) -> None:
        self.path = path
        self._pycolmap = pycolmap

    @contextmanager
    def opened(self) -> Iterator[Any]:
        """Open it; made if it is not there.

        Raises:
            DataError: it is damaged.
        """
        try:
            database = self._pycolmap.Database.open(self.path)
            try:
                yield database
            finally:
                database.close()
        except (RuntimeError, ValueError, IndexError) as error:
            raise DataError(
                f"{self.path} is damaged ({_first_line(error)}): delete {self.path.parent}, then give the "
                "command again"
            ) from error

    def num_features(self) -> dict[str, int]:
        """Return the number of features of each image that has been looked at."""
        with self.opened() as database:
            return {
                image.name: int(database.num_keypoints_for_image(image.image_id))
                for image in database.read_all_images()
                if database.exists_keypoints(image.image_id)
            }

    def matched_pairs(self) -> dict[tuple[str, str], tuple[int, str]]:
        """Return number of inliers and ``TwoViewGeometryConfiguration`` of each pair that was compared."""
        with self.opened() as database:
            names = {image.image_id: image.name for image in database.read_all_images()}
            ids, geometries = database.read_two_view_geometries()
            kind = self._pycolmap.TwoViewGeometryConfiguration
            pairs = [self._pycolmap.pair_id_to_image_pair(pair) for pair in ids]
            return {
                (names[a], names[b]): (len(geometry.inlier_matches), kind(geometry.config).name)
                for (a, b), geometry in zip(pairs, geometries, strict=True)
            }


def _extract(pycolmap: Any, database: _Database, images: Path, names: list[str], tell: Progress) -> None:
    """Find the features of the images that have none yet."""
    reader = pycolmap.ImageReaderOptions(camera_model=CAMERA_MODEL, default_focal_length_factor=_FOCAL_FACTOR)
    with database.opened() as opened:
        is_new = opened.num_images() == 0
    if is_new:
        # Threads find features in any order: images get their numbers before that, in the film's order.
        mode = pycolmap.CameraMode.SINGLE
        pycolmap.import_images(database.path, images, mode, image_names=names, options=reader)
    reader.existing_camera_id = 1
    found = database.num_features()
    missing = [name for name in names if name not in found]
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = _MAX_FEATURES
    for start in range(0, len(missing), _BATCH):
        tell("finding features", len(names) - len(missing) + start, len(names))
        work = partial(
            pycolmap.extract_features,
            database.path,
            images,
            image_names=missing[start : start + _BATCH],
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        _uninterrupted(work, pycolmap.CancellationToken())
    if missing:
        tell("finding features", len(names), len(names))


def _match(
    pycolmap: Any, database: _Database, pairs: list[tuple[str, str]], listed: Path, tell: Progress
) -> None:
    """Match the pairs that were not compared yet."""
    done = database.matched_pairs()
    missing = [pair for pair in pairs if pair not in done and pair[::-1] not in done]
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = _SEED
    size = _BATCH * _OVERLAP
    for start in range(0, len(missing), size):
        tell("matching frames", len(pairs) - len(missing) + start, len(pairs))
        write_text(listed, "".join(f"{a} {b}\n" for a, b in missing[start : start + size]))
        work = partial(
            pycolmap.match_image_pairs,
            database.path,
            pairing_options=pycolmap.ImportedPairingOptions(match_list_path=listed),
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
        _uninterrupted(work, pycolmap.CancellationToken())
    if missing:
        tell("matching frames", len(pairs), len(pairs))


def pairs_to_match(names: Sequence[str], kind: str) -> list[tuple[str, str]]:
    """Return the pairs of frames that are compared.

    Args:
        names: in the order of the film.
        kind: ``exhaustive``: all; ``sequential``: each with the next ten, and those 16, 32, 64, … after it.
    """
    count = len(names)
    steps = range(1, count)
    if kind == "sequential":
        steps_apart = {*range(1, _OVERLAP + 1), *(2**power for power in range(count.bit_length()))}
        return [(names[i], names[i + s]) for i in range(count) for s in sorted(steps_apart) if i + s < count]
    return [(names[i], names[i + step]) for step in steps for i in range(count - step)]


def _map(pycolmap: Any, database: _Database, images: Path, model: Path, count: int, tell: Progress) -> None:
    """Write the models to a folder that appears when they are whole."""
    registered = [0]

    def one_more() -> None:
        registered[0] = min(count, registered[0] + 1)

    with finished_folder(model) as folder:
        # Several threads add up in any order, and a last bit decides which points are kept.
        options = pycolmap.IncrementalPipelineOptions(random_seed=_SEED, num_threads=1, extract_colors=False)
        work = partial(
            pycolmap.incremental_mapping,
            database.path,
            images,
            folder,
            options,
            next_image_callback=one_more,
        )
        _uninterrupted(
            work,
            pycolmap.CancellationToken(),
            lambda: tell("placing the cameras", registered[0], count),
        )


def _uninterrupted(work: Callable[..., Any], token: Any, report: Callable[[], None] | None = None) -> None:
    """Run what pycolmap does in a thread of its own; Ctrl-C ends it where its database is whole.

    Args:
        work: given the token as ``cancellation_token``.
        token: by which it is told to end.
        report: called again and again meanwhile.
    """
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(lambda: work(cancellation_token=token))
        try:
            while not future.done():
                wait([future], timeout=_EVERY)
                if report is not None:
                    report()
            future.result()
        except KeyboardInterrupt:
            token.cancel()
            raise
        except (RuntimeError, ValueError) as error:
            raise DataError(f"pycolmap gave up ({_first_line(error)}): give the command again") from error


def _first_line(error: Exception) -> str:
    lines = str(error).splitlines()
    return lines[0][:200] if lines else type(error).__name__


def _largest(pycolmap: Any, folder: Path, names: list[str]) -> FoundCameras:
    """Return the largest of the models in a folder; it has no frames if there is none.

    Raises:
        DataError: one is damaged.
    """
    try:
        models = [pycolmap.Reconstruction(part) for part in sorted(folder.iterdir()) if part.is_dir()]
    except (RuntimeError, ValueError) as error:
        raise DataError(
            f"{folder} is damaged ({_first_line(error)}): delete it, then give the command again"
        ) from error
    if not models:
        nothing = np.zeros((0, 4, 4))
        return FoundCameras((), nothing, (1, 1), 1.0, (0, 0), 0.0, np.zeros((0, 3)), len(names), 0, 0.0)
    model = max(models, key=lambda model: model.num_reg_images())
    images = {image.name: image for image in model.images.values() if image.has_pose}
    registered = tuple(name for name in names if name in images)
    poses = np.tile(np.eye(4), (len(registered), 1, 1))
    poses[:, :3] = [images[name].cam_from_world().inverse().matrix() for name in registered]
    (camera,) = model.cameras.values()
    focal, cx, cy, distortion = (float(value) for value in camera.params)
    points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    return FoundCameras(
        names=registered,
        world_from_camera=poses,
        image_size=(camera.height, camera.width),
        focal=focal,
        center=(cx, cy),
        distortion=distortion,
        points=points,
        num_frames=len(names),
        num_models=len(models),
        error=float(model.compute_mean_reprojection_error()),
    )


def _too_few(database: _Database, registered: int, names: Sequence[str]) -> DataError:
    """Return the error for a film of whose frames too few fit together, with what the matches tell of it."""
    features, compared = database.num_features(), database.matched_pairs()
    near = [compared.get(pair, (0, "")) for pair in pairwise(names)]
    matched = [config for inliers, config in near if inliers]
    count = len(names)
    start = f"only {registered} of {count} frames can be placed beside each other"
    if not features or float(np.median(list(features.values()))) < _LITTLE_TEXTURE:
        return DataError(
            f"{start}: they show too little texture; film with more light, and with furniture and edges in "
            "the picture rather than bare walls"
        )
    if len(matched) < _FEW_NEIGHBOURS * max(1, count - 1):
        return DataError(
            f"{start}: neighbours in the film have too little in common; film slower, or give frames= larger"
        )
    if sum(config in _PANORAMAS for config in matched) > _TURNED * len(matched):
        return DataError(
            f"{start}: the camera only turned on the spot, which tells no distances; walk sideways and "
            "around the furniture while filming"
        )
    return DataError(
        f"{start}: film slower and steadier, with most of each picture in the next one too, and walk around "
        "the furniture"
    )
