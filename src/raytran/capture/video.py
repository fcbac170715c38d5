# SPDX-License-Identifier: Apache-2.0
"""Videos with a pose track beside them, decoded by PyAV one frame at a time."""

from __future__ import annotations

import importlib
import logging
import shlex
import struct
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
    is_for_shown,
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
from raytran.data.images import ImageHeader, OrientationTags, resize, turned_image
from raytran.data.scan import NO_POSE
from raytran.errors import ConfigError, DataError
from raytran.limits import MAX_SIDE

_log = logging.getLogger(__name__)

VIDEO_ENDINGS = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm")

_SEEK_FROM = 64
"""A frame this many or more ahead is reached from a key frame; a nearer one by decoding on."""


_UNEVEN = 0.2
"""Relative difference of the time between two frames from the median for which a rate is not constant."""

_EVEN = 0.05
"""The same of poses, below which theirs is constant."""

_SAME_RATE = 0.35
"""Relative difference of two rates that may be the nominal and the mean rate of one video."""

_AT_FRAME = 0.002
"""Seconds between a pose and a frame that are taken for the same moment, where a rate is not constant."""

_ORIENTATIONS = {
    **{(1, 0, 0, 1): 1, (-1, 0, 0, 1): 2, (-1, 0, 0, -1): 3, (1, 0, 0, -1): 4},
    **{(0, 1, 1, 0): 5, (0, 1, -1, 0): 6, (0, -1, -1, 0): 7, (0, -1, 1, 0): 8},
}
"""Where a display matrix (ISO 14496-12, §8.3.2) takes the picture's axes → the EXIF orientation that does."""


class VideoFile:
    """A video, open for reading; opening it finds the time of every frame and decodes only the first.

    Args:
        path: a file that PyAV can read.

    Attributes:
        path: as given.
        image_size: ``(H, W)`` as coded, a rotation for display left out.
        orientation: EXIF orientation that the rotation for display amounts to, 1 for none.
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
        self.orientation = self._displayed()

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def read(self, number: int) -> NDArray[np.uint8]:
        """Return frame ``number`` as coded, ``(H, W, 3)`` RGB.

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

    def _displayed(self) -> int:
        """Return the EXIF orientation that the first frame's display matrix asks for."""
        try:
            self._container.seek(int(self._pts[0]), stream=self._stream, backward=True)
            frame = next(self._container.decode(self._stream))
            matrix = next(bytes(data) for data in frame.side_data if data.type.name == "DISPLAYMATRIX")
            a, b, _, c, d = struct.unpack_from("=5i", matrix)
        except (
            self._av.FFmpegError,
            StopIteration,
            struct.error,
        ):  # damaged frames are told when they are read
            return 1
        largest = max(abs(value) for value in (a, b, c, d)) or 1
        return _ORIENTATIONS.get(tuple(round(value / largest) for value in (a, b, c, d)), 1)

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
    """Images that are frames of a video, turned as it is displayed or as they are coded."""

    def __init__(self, file: VideoFile, numbers: list[int], tags: OrientationTags | None = None) -> None:
        self._file, self._numbers, self._tags = file, numbers, tags

    @property
    def tags(self) -> OrientationTags | None:
        """See ``FrameImages``."""
        return self._tags

    def with_tags(self, tags: OrientationTags) -> VideoFrames:
        """See ``FrameImages``."""
        return VideoFrames(self._file, self._numbers, tags)

    def read(
        self, index: int, image_size: tuple[int, int] | None, stored: tuple[int, int]
    ) -> NDArray[np.uint8]:
        """See ``FrameImages``."""
        pixels = self._file.read(self._numbers[index])
        if self._tags is not None:
            pixels = turned_image(pixels, self._tags.turn(index))
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
    Intrinsics are for frames as they are displayed, or as they are coded if their principal point says so.

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
        times, header = file.times, ImageHeader(file.image_size, file.orientation)
    finally:
        file.close()
    if intrinsics is None:
        listed = _beside(video, (f"{video.stem}.intrinsics.txt", *INTRINSICS_NAMES), "intrinsics")
        lens = read_camera(listed, header.shown_size, header.size)
    else:
        lens = typed_lens(intrinsics, header.shown_size, header.size)
    poses = _poses(track, times, video)
    has_pose = [bool(np.isfinite(pose).all()) for pose in poses]
    return Recording(
        path=video,
        scene_id=video.stem,
        frames=tuple(Frame(str(n), video, poses[n], lens, n) for n, known in enumerate(has_pose) if known),
        dropped={str(n): NO_POSE for n, known in enumerate(has_pose) if not known},
        aligned=True,
        honours_exif=True,
    )


def open_video(recording: Recording) -> RecordedScan:
    """Return the scan of a recording whose images are frames of one video.

    Raises:
        DataError: see ``VideoFile`` and ``build_scan``.
    """
    file = VideoFile(recording.path)
    header = ImageHeader(file.image_size, file.orientation)

    def is_turned(frame: Frame) -> bool:
        return is_for_shown(frame.lens.size, header, default=recording.honours_exif)

    def open_images(frames: list[Frame]) -> VideoFrames:
        numbers = [frame.number for frame in frames]
        if header.orientation == 1:
            return VideoFrames(file, numbers)
        applied = tuple(is_turned(frame) for frame in frames)
        return VideoFrames(file, numbers, OrientationTags((header.orientation,) * len(frames), applied))

    try:
        return build_scan(
            recording, lambda frame: header.shown_size if is_turned(frame) else header.size, open_images
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
    numbers = _numbers_of_poses(track.times, times)
    if numbers is not None:
        _log.warning(
            "%s: its frames come at another or a variable rate than the poses in %s, %d for %d frames: they "
            "are matched by number",
            video.stem,
            track.path.name,
            len(track),
            len(times),
        )
        poses = np.full((len(times), 4, 4), np.nan)
        poses[numbers] = track.world_from_camera
        return poses
    poses = poses_at(track, times)
    if not np.isfinite(poses).all(axis=(1, 2)).any():
        raise DataError(
            f"{video} lasts from 0 to {times[-1]:.1f} s and the poses in {track.path.name} from "
            f"{track.times[0]:.1f} to {track.times[-1]:.1f} s: give times in seconds since the first frame"
        )
    return poses


def _numbers_of_poses(
    pose_times: NDArray[np.float64], times: NDArray[np.float64]
) -> NDArray[np.int64] | None:
    """Return the number of the frame that each pose is of, if its time is that number over a constant rate.

    Programs that were given the frames one by one know their numbers alone and write them as n / fps. In a
    video of variable rate, or of another one than they were told, the frame was not shown at that time.

    Args:
        pose_times: ``(m,)`` seconds, rising.
        times: ``(n,)`` seconds of the frames since the first, rising.

    Returns:
        None if poses have times of their own, or it makes no difference.
    """
    if min(len(pose_times), len(times)) < 3 or not np.isfinite(pose_times).all():
        return None
    steps, pose_steps = np.diff(times), np.diff(pose_times)
    interval = float(pose_steps.min())
    count = pose_times / interval
    if len(pose_times) == len(times) and abs(count[0]) < 2:
        count = count - count[0]
    if not np.abs(count).max() < 1e9:  # times of no video, which are no whole numbers either
        return None
    numbers = count.round().astype(np.int64)
    rates = [abs(interval / step - 1) for step in (np.median(steps), steps.mean())]
    is_grid = np.abs(count - numbers).max() < _EVEN * max(1.0, 0.01 * len(times)) and min(rates) < _SAME_RATE
    if not is_grid or numbers[0] < 0 or numbers[-1] >= len(times):
        return None
    off = np.abs(times[numbers] - pose_times)
    if off.max() < interval / 2:
        return None
    if len(pose_times) == len(times):
        return numbers
    is_variable = (np.abs(steps / np.median(steps) - 1) > _UNEVEN).any()
    after = np.searchsorted(times, pose_times).clip(1, len(times) - 1)
    nearest = np.minimum(np.abs(times[after] - pose_times), np.abs(times[after - 1] - pose_times))
    return numbers if is_variable and (nearest > _AT_FRAME).mean() > 0.5 else None


def _beside(video: Path, names: tuple[str, ...], what: str) -> Path:
    """Return the first of some files in a video's folder."""
    path = next((video.with_name(name) for name in names if video.with_name(name).is_file()), None)
    if path is None:
        form = "`timestamp tx ty tz qx qy qz qw` lines" if what == "pose track" else "`fx fy cx cy`"
        other = ", or give intrinsics=fx,fy,cx,cy"
        if what == "pose track":
            other = f", or let raytran poses {shlex.quote(video.name)} find them"
        raise DataError(
            f"{video} has no {what} beside it: write {form} to {video.with_name(names[0]).name}{other}"
        )
    return path


def _pyav() -> Any:
    try:
        return importlib.import_module("av")
    except ImportError as error:
        raise ConfigError(
            "videos are read by PyAV, which is not installed: pip install 'raytran[video]'"
        ) from error
