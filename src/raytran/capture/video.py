# SPDX-License-Identifier: Apache-2.0
"""Videos with a pose track beside them, decoded by PyAV one frame at a time."""

from __future__ import annotations

import importlib
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from raytran.capture.names import is_hidden
from raytran.capture.recording import (
    Frame,
    FrameImages,
    Intrinsics,
    RecordedScan,
    Recording,
    build_scan,
    typed_lens,
)
from raytran.capture.trajectory import (
    INTRINSICS_NAMES,
    TRACK_NAMES,
    Track,
    poses_at,
    read_camera,
    read_track,
)
from raytran.data.images import resize
from raytran.data.scan import NO_POSE
from raytran.errors import ConfigError, DataError
from raytran.limits import MAX_SIDE

_log = logging.getLogger(__name__)

VIDEO_ENDINGS = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm")

_SEEK_FROM = 64
"""A frame this many or more ahead is reached from a key frame; a nearer one by decoding on."""


class VideoFile:
    """A video, open for reading; opening it finds the time of every frame without decoding any.

    Args:
        path: a file that PyAV can read.

    Attributes:
        path: as given.
        image_size: ``(H, W)`` as coded, a rotation for display left out.
        times: ``(n,)`` seconds of each frame since the first.

    Raises:
        ConfigError: PyAV is not installed.
        DataError: it cannot be read, has no frames, or its frames are larger than ``MAX_SIDE``.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._av = _pyav()
        try:
            self._container = self._av.open(str(path))
        except self._av.FFmpegError as error:
            raise DataError(
                f"cannot read the video {path} ({error.strerror or error}): copy or export it again"
            ) from error
        try:
            self._stream = self._first_stream()
            self._pts = self._frame_times()
        except BaseException:
            self._container.close()
            raise
        self.times = (self._pts - self._pts[0]) * float(self._stream.time_base)
        self._frames: Iterator[Any] = iter(())
        self._next = len(self._pts)

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def read(self, number: int) -> NDArray[np.uint8]:
        """Return frame ``number``, ``(H, W, 3)`` RGB.

        Raises:
            DataError: it cannot be decoded, or is of another size than the first.
        """
        wanted = int(self._pts[number])
        try:
            if not self._next <= number < self._next + _SEEK_FROM:
                self._container.seek(wanted, stream=self._stream, backward=True)
                self._frames = self._container.decode(self._stream)
            for frame in self._frames:
                if frame.pts is not None and frame.pts >= wanted:
                    self._next = int(np.searchsorted(self._pts, frame.pts, side="right"))
                    return self._pixels(frame, number, wanted)
        except self._av.FFmpegError as error:
            self._next = len(self._pts)
            raise DataError(
                f"cannot decode frame {number} of {self.path} ({error.strerror or error}): copy or "
                "export it again"
            ) from error
        self._next = len(self._pts)
        raise DataError(f"{self.path} ends before frame {number}: copy or export it again")

    def _pixels(self, frame: Any, number: int, wanted: int) -> NDArray[np.uint8]:
        if frame.is_corrupt or frame.pts != wanted or (frame.height, frame.width) != self.image_size:
            raise DataError(f"frame {number} of {self.path} is damaged or of another size: export it again")
        pixels: NDArray[np.uint8] = frame.to_ndarray(format="rgb24")
        return pixels

    def _first_stream(self) -> Any:
        if not self._container.streams.video:
            raise DataError(f"{self.path} has no pictures, only other streams: give a video")
        stream = self._container.streams.video[0]
        if stream.codec_context is None:  # FFmpeg knows of no decoder
            raise DataError(f"{self.path} has pictures of a kind that FFmpeg cannot decode: export it again")
        width, height = stream.codec_context.width, stream.codec_context.height
        if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
            raise DataError(
                f"{self.path} claims frames of {width}x{height}, and 1 to {MAX_SIDE} pixels a side are read: "
                "export it smaller"
            )
        self.image_size = (int(height), int(width))
        return stream

    def _frame_times(self) -> NDArray[np.int64]:
        """Return the presentation time of every frame, in the stream's time base, without decoding."""
        try:
            pts = [
                packet.pts
                for packet in self._container.demux(self._stream)
                if packet.pts is not None and not packet.is_discard
            ]
        except self._av.FFmpegError as error:
            raise DataError(
                f"cannot read the video {self.path} ({error.strerror or error}): copy it again"
            ) from error
        if not pts:
            raise DataError(f"{self.path} has no frames: copy or export it again")
        return np.unique(np.array(pts, dtype=np.int64))


class VideoFrames(FrameImages):
    """Images that are frames of a video."""

    def __init__(self, file: VideoFile, numbers: list[int]) -> None:
        self._file, self._numbers = file, numbers

    def read(
        self, index: int, image_size: tuple[int, int] | None, stored: tuple[int, int]
    ) -> NDArray[np.uint8]:
        """See ``FrameImages``."""
        pixels = self._file.read(self._numbers[index])
        return pixels if image_size in (None, pixels.shape[:2]) else resize(pixels, image_size)

    def close(self) -> None:
        """Close the video."""
        self._file.close()


def find_video(path: Path) -> Path | None:
    """Return the video that ``path`` is, or the only one in that folder; None if there is none or several."""
    if path.is_file():
        return path if path.suffix.lower() in VIDEO_ENDINGS else None
    children = [child for child in path.iterdir() if not is_hidden(child.name)] if path.is_dir() else []
    videos = [child for child in children if child.suffix.lower() in VIDEO_ENDINGS]
    return videos[0] if len(videos) == 1 else None


def read_video(path: Path, intrinsics: Intrinsics | None = None) -> Recording:
    """Read the poses of a video's frames.

    Beside ``walk.mp4`` lie its poses, ``walk.txt`` or ``trajectory.txt``, and ``walk.intrinsics.txt`` or
    ``intrinsics.txt``. Times are seconds since the first frame; poses without times are one per frame.

    Args:
        path: the video, or the folder that holds no other.
        intrinsics: of the stored frames, in place of those in a file.

    Raises:
        DataError: a part is missing or damaged, or poses and frames are of other numbers or times.
    """
    video = find_video(path)
    if video is None:
        raise DataError(f"{path} is or holds no single video ({', '.join(VIDEO_ENDINGS)}): give its path")
    track = read_track(_beside(video, (f"{video.stem}.txt", f"{video.stem}.tum", *TRACK_NAMES), "pose track"))
    file = VideoFile(video)
    try:
        times, image_size = file.times, file.image_size
    finally:
        file.close()
    if intrinsics is None:
        listed = _beside(video, (f"{video.stem}.intrinsics.txt", *INTRINSICS_NAMES), "intrinsics")
        lens = read_camera(listed, image_size)
    else:
        lens = typed_lens(intrinsics, image_size)
    poses = _poses(track, times, video)
    has_pose = [bool(np.isfinite(pose).all()) for pose in poses]
    return Recording(
        path=video,
        scene_id=video.stem,
        frames=tuple(Frame(str(n), video, poses[n], lens, n) for n, known in enumerate(has_pose) if known),
        dropped={str(n): NO_POSE for n, known in enumerate(has_pose) if not known},
    )


def open_video(recording: Recording) -> RecordedScan:
    """Return the scan of a recording whose images are frames of one video.

    Raises:
        DataError: see ``VideoFile`` and ``build_scan``.
    """
    file = VideoFile(recording.path)
    try:
        return build_scan(
            recording,
            lambda frame: file.image_size,
            lambda frames: VideoFrames(file, [frame.number for frame in frames]),
        )
    except BaseException:
        file.close()
        raise


def _poses(track: Track, times: NDArray[np.float64], video: Path) -> NDArray[np.float64]:
    """Return the pose of each frame, ``(n, 4, 4)``; not finite where there is none."""
    if track.times is None:
        if abs(len(track) - len(times)) > 1:
            raise DataError(
                f"{video} has {len(times)} frames and {track.path.name} {len(track)} poses without times: "
                "give one per frame, or a timestamp with each (`timestamp tx ty tz qx qy qz qw`)"
            )
        if len(track) != len(times):
            # Frames and poses are in the order of time, and recordings are cut at their end.
            more = "pose" if len(track) > len(times) else "frame"
            _log.warning("%s: the last %s has no partner and is left out", video, more)
        lost = np.full((1, 4, 4), np.nan)
        return np.concatenate([track.world_from_camera, lost])[: len(times)]
    poses = poses_at(track, times)
    if not np.isfinite(poses).all(axis=(1, 2)).any():
        raise DataError(
            f"{video} lasts from 0 to {times[-1]:.1f} s and the poses in {track.path.name} from "
            f"{track.times[0]:.1f} to {track.times[-1]:.1f} s: give times in seconds since the first frame"
        )
    return poses


def _beside(video: Path, names: tuple[str, ...], what: str) -> Path:
    """Return the first of some files in a video's folder."""
    path = next((video.with_name(name) for name in names if video.with_name(name).is_file()), None)
    if path is None:
        form = "`timestamp tx ty tz qx qy qz qw` lines" if what == "pose track" else "`fx fy cx cy`"
        typed = "" if what == "pose track" else ", or give intrinsics=fx,fy,cx,cy"
        raise DataError(
            f"{video} has no {what} beside it: write {form} to {video.with_name(names[0]).name}{typed}"
        )
    return path


def _pyav() -> Any:
    try:
        return importlib.import_module("av")
    except ImportError as error:
        raise ConfigError("videos are read by PyAV, which is not installed: pip install av") from error
