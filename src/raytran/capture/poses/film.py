# SPDX-License-Identifier: Apache-2.0
"""A film whose poses are not known: a video, or a folder of images in the order of their names."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from raytran.capture.names import frame_name, images_in, unlike
from raytran.capture.video import VIDEO_ENDINGS, VideoFile, find_video
from raytran.data.images import decode_image, read_header, turned_image
from raytran.errors import DataError


class Film(ABC):
    """Frames that can be read one by one, best from front to back.

    Attributes:
        path: as given.
        names: of its frames, fit for file names; their order is that of the film.
    """

    path: Path
    names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.names)

    @abstractmethod
    def read(self, number: int) -> NDArray[np.uint8]:
        """Return a frame as a person sees it, ``(H, W, 3)`` RGB.

        Raises:
            DataError: it is damaged.
        """

    def close(self) -> None:
        """Close what is open."""
        return


class VideoFilm(Film):
    """The frames of a video, named by their numbers.

    Raises:
        ConfigError: PyAV is not installed.
        DataError: see ``VideoFile``.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = VideoFile(path)
        self.names = tuple(f"{number:06d}" for number in range(len(self._file.times)))

    def read(self, number: int) -> NDArray[np.uint8]:
        """See ``Film``."""
        return turned_image(self._file.read(number), self._file.orientation)

    def close(self) -> None:
        """See ``Film``."""
        self._file.close()


class ImageFilm(Film):
    """The images in a folder.

    Raises:
        DataError: there is none.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._images = images_in(path)
        if not self._images:
            raise DataError(f"{path} holds no video and no images: give the path of a video")
        # COLMAP parts names in its lists by spaces.
        self.names = tuple(unlike(["_".join(frame_name(image.name).split()) for image in self._images]))

    def read(self, number: int) -> NDArray[np.uint8]:
        """See ``Film``."""
        image = self._images[number]
        pixels = decode_image(image, name=str(image), orientation=read_header(image).orientation)
        array: NDArray[np.uint8] = pixels.permute(1, 2, 0).numpy()
        return array


def open_film(path: Path) -> Film:
    """Open a video, a folder with one, or a folder of images; ``images/`` and ``rgb/`` below it will do.

    Raises:
        ConfigError: PyAV is not installed.
        DataError: it is none of these, or cannot be read.
    """
    if not path.exists():
        raise DataError(f"there is no video {path}: check the path")
    video = find_video(path)
    if video is not None:
        return VideoFilm(video)
    if path.is_file():
        raise DataError(f"{path} is no video ({', '.join(VIDEO_ENDINGS)}): give one, or a folder of images")
    below = (path, path / "images", path / "rgb")
    return ImageFilm(next((folder for folder in below if folder.is_dir() and images_in(folder)), path))
