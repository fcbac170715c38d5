# SPDX-License-Identifier: Apache-2.0
"""One scan, its cameras read and its images at hand, whether it lies in a folder or a recording."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from raytran.data.images import decode_image
from raytran.data.scannet.sens import SensFile
from raytran.errors import DataError


@dataclass(frozen=True, kw_only=True)
class OpenScan(ABC):
    """The usable frames of one scan; use it in a ``with`` statement, or close it.

    Attributes:
        scene_id: e.g. ``scene0470_00``.
        frame_id: name of each usable frame, in the order of the numbers in it.
        world_from_camera: ``(n, 4, 4)`` float64, metres.
        intrinsics: ``(3, 3)`` float64 for images of the stored size, pixels.
        image_size: ``(H, W)`` as stored.
        axis_alignment: ``(4, 4)`` float64, aligned_from_world; identity if the scan has none.
        dropped: reason for each frame that was left out, by frame name.
        damage: a sentence about a file that ends early, or None.
    """

    scene_id: str
    frame_id: tuple[str, ...]
    world_from_camera: Tensor
    intrinsics: Tensor
    image_size: tuple[int, int]
    axis_alignment: Tensor
    dropped: dict[str, str]
    damage: str | None = None

    def __len__(self) -> int:
        return len(self.frame_id)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    @abstractmethod
    def path(self) -> Path:
        """Folder or file that it is read from."""

    @abstractmethod
    def color_bytes(self, index: int) -> bytes | None:
        """Return usable frame ``index`` as stored, if that is a JPEG or PNG, else None.

        Raises:
            DataError: it cannot be read.
        """

    @abstractmethod
    def read_color(self, index: int, image_size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """Return ``(H, W, 3)`` RGB of usable frame ``index``, resized to ``image_size`` if given.

        Raises:
            DataError: the image is damaged or of another size than ``self.image_size``.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the file, if one is open."""


@dataclass(frozen=True, kw_only=True)
class Scan(OpenScan):
    """The usable frames of a folder.

    Attributes:
        folder: where it lies.
        image_path: file of each usable frame.
    """

    folder: Path
    image_path: tuple[Path, ...]

    @property
    def path(self) -> Path:
        """The scan's folder."""
        return self.folder

    def color_bytes(self, index: int) -> bytes:
        """See ``OpenScan``."""
        path = self.image_path[index]
        try:
            return path.read_bytes()
        except OSError as error:
            raise DataError(
                f"cannot read the image {path} ({error.strerror}): copy or export it again"
            ) from error

    def read_color(self, index: int, image_size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """See ``OpenScan``."""
        path = self.image_path[index]
        image = decode_image(path, name=str(path), image_size=image_size, stored=self.image_size)
        return image.permute(1, 2, 0).numpy()

    def close(self) -> None:
        """Do nothing: no file is open."""


@dataclass(frozen=True, kw_only=True)
class SensScan(OpenScan):
    """The usable frames of a ``.sens`` recording.

    Attributes:
        file: the open recording.
        file_index: number of each usable frame in it.
    """

    file: SensFile
    file_index: tuple[int, ...]

    @property
    def path(self) -> Path:
        """The recording."""
        return self.file.path

    def color_bytes(self, index: int) -> bytes | None:
        """See ``OpenScan``."""
        return self.file.color_bytes(self.file_index[index])

    def read_color(self, index: int, image_size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """See ``OpenScan``."""
        return self.file.read_color(self.file_index[index], image_size)

    def close(self) -> None:
        """Close the recording."""
        self.file.close()
