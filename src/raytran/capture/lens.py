# SPDX-License-Identifier: Apache-2.0
"""Lenses: COLMAP's models of distortion, and resampling the images of a lens to those of a pinhole camera.

Distortion is computed by pycolmap (extra ``colmap``), which knows every model of COLMAP, fisheyes among them.
A camera without distortion needs no extra.
"""

from __future__ import annotations

import importlib
import signal
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample

from raytran.data.images import is_turned
from raytran.data.scan import TURNED
from raytran.errors import ConfigError, DataError
from raytran.geometry.camera import FARTHEST_CENTER, center_offset, other_image_size
from raytran.limits import MAX_SIDE, PIXEL

_SAME_PX = 0.25
"""Largest shift of a pixel for which an image is used without resampling, pixels."""

_MAX_ZOOM = 1.5
"""Largest zoom that leaves no corner of a straightened image empty; lenses that need more are none."""

_SHORTEST, _LONGEST = 0.02, 1000.0
"""Focal lengths in widths and heights of the image between which those of lenses lie: angles of view of 175°
and of 3 minutes of arc."""

_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE")
_PINHOLE_AT_ZERO = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "SIMPLE_DIVISION", "DIVISION")
"""Models that are a pinhole when all their coefficients are zero."""


class UnfitLens(DataError):
    """What a file says is no lens of its image.

    Args:
        message: the sentence for a user who has no other frame.
        reason: in a few words, for the list of frames that are left out.
    """

    def __init__(self, message: str, reason: str) -> None:
        super().__init__(message)
        self.reason = reason


@dataclass(frozen=True)
class LensModel:
    """The layout of a COLMAP camera model's parameters: focal lengths, principal point, distortion.

    Attributes:
        name: e.g. ``OPENCV_FISHEYE``.
        num_focal: 1 (one focal length f) or 2 (fx, fy).
        num_params: number of all parameters.
    """

    name: str
    num_focal: int
    num_params: int


@dataclass(frozen=True)
class Lens:
    """A camera: a pinhole, and the distortion of one of COLMAP's models; hashable.

    A point (x, y) of the plane at depth one is imaged at ``focal · d(x, y) + center``, where d is the model
    with unit focal length (COLMAP, "Camera Models"; OpenCV, "Camera Calibration and 3D Reconstruction").

    Attributes:
        size: ``(H, W)`` of its images.
        focal: fx, fy in pixels.
        center: cx, cy in pixels from the image's corner.
        model: name of the COLMAP model.
        distortion: the model's parameters after the principal point.
        radial_8: coefficient of r⁸ that is added to the radial factor: nerfstudio's ``k4``, which no
            perspective model of COLMAP has.
    """

    size: tuple[int, int]
    focal: tuple[float, float]
    center: tuple[float, float]
    model: str = "PINHOLE"
    distortion: tuple[float, ...] = ()
    radial_8: float = 0.0

    @property
    def matrix(self) -> Tensor:
        """``(3, 3)`` float64 intrinsics, without the distortion."""
        (fx, fy), (cx, cy) = self.focal, self.center
        return torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)

    @property
    def is_pinhole(self) -> bool:
        """Whether straight lines stay straight."""
        is_zero = not any(self.distortion) and self.radial_8 == 0
        return self.model in _PINHOLES or (self.model in _PINHOLE_AT_ZERO and is_zero)

    def scaled_to(self, size: tuple[int, int]) -> Lens:
        """Return the lens of the same images resized to ``size`` (H, W)."""
        scale_y = size[0] / self.size[0]
        scale_x = size[1] / self.size[1]
        (fx, fy), (cx, cy) = self.focal, self.center
        focal = (fx * scale_x, fy * scale_y)
        return replace(self, size=size, focal=focal, center=(cx * scale_x, cy * scale_y))

    def distort(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return d of points ``(..., 2)`` of the plane at depth one; NaN where the model has no image.

        Raises:
            ConfigError: the lens distorts and pycolmap is not installed.
        """
        if self.is_pinhole:
            return points
        flat = points.reshape(-1, 2)
        rays = np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
        distorted = _unit_camera(self.model, self.distortion).img_from_cam(rays)
        if self.radial_8:
            distorted = distorted + self.radial_8 * (flat**2).sum(axis=1, keepdims=True) ** 4 * flat
        return np.asarray(distorted, dtype=np.float64).reshape(points.shape)

    def image_of(self, pinhole: Lens, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where this lens shows what a pinhole with the same pose shows at ``pixels`` ``(..., 2)``."""
        plane = (pixels - np.array(pinhole.center)) / np.array(pinhole.focal)
        return self.distort(plane) * np.array(self.focal) + np.array(self.center)


def lens_model(model: str | int, where: str) -> LensModel:
    """Return the parameter layout of a COLMAP camera model.

    Args:
        model: its name, or its number in binary files.
        where: name of the camera in messages.

    Raises:
        ConfigError: it distorts and pycolmap is not installed.
        DataError: pycolmap does not know it, or it is no lens but a panorama.
    """
    if model in ("SIMPLE_PINHOLE", 0):
        return LensModel("SIMPLE_PINHOLE", 1, 3)
    if model in ("PINHOLE", 1):
        return LensModel("PINHOLE", 2, 4)
    pycolmap = load_pycolmap()
    models = {name: int(id_.value) for name, id_ in pycolmap.CameraModelId.__members__.items()}
    name = model if isinstance(model, str) else next((n for n, id_ in models.items() if id_ == model), "")
    if name not in models or name == "INVALID":
        raise DataError(
            f"{where} has the lens model {str(model)[:50]}, which pycolmap {pycolmap.__version__} does not "
            "know: undistort the images with COLMAP's image_undistorter and give the folder that it writes"
        )
    camera = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId.__members__[name], 1.0, 1, 1)
    if not len(camera.focal_length_idxs()):
        raise DataError(f"{where} is a panorama ({name}): cut it into perspective images and give these")
    return LensModel(name, len(camera.focal_length_idxs()), len(camera.params))


def colmap_lens(model: str | int, size: tuple[int, int], params: Sequence[float], where: str) -> Lens:
    """Return the lens that COLMAP describes by a model and its parameters.

    Args:
        model: name or number of the camera model.
        size: ``(H, W)`` of the images.
        params: in COLMAP's order.
        where: name of the camera in messages.

    Raises:
        ConfigError, DataError: see ``lens_model`` and ``check_lens``; or the parameters are too few or many.
    """
    layout = lens_model(model, where)
    if len(params) != layout.num_params:
        raise DataError(
            f"{where} has {len(params)} parameters for {layout.name}, not {layout.num_params}: "
            "export it again"
        )
    fx, fy = params[0], params[layout.num_focal - 1]
    cx, cy, *distortion = params[layout.num_focal :]
    name = "PINHOLE" if layout.name in _PINHOLES else layout.name
    return check_lens(Lens(size, (fx, fy), (cx, cy), name, tuple(distortion)), where)


def opencv_lens(
    size: tuple[int, int],
    focal: tuple[float, float],
    center: tuple[float, float],
    radial: tuple[float, float, float, float],
    tangential: tuple[float, float],
    where: str,
) -> Lens:
    """Return a perspective lens with OpenCV's distortion, which programs other than COLMAP write.

    Args:
        size: ``(H, W)`` of the images.
        focal: fx, fy, pixels.
        center: cx, cy, pixels.
        radial: coefficients of r², r⁴, r⁶ and r⁸.
        tangential: p1, p2.
        where: name of the camera in messages.

    Raises:
        ConfigError, DataError: see ``check_lens``.
    """
    k1, k2, k3, k4 = radial
    p1, p2 = tangential
    lens = Lens(size, focal, center, "FULL_OPENCV", (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0), radial_8=k4)
    return check_lens(Lens(size, focal, center) if lens.is_pinhole else lens, where)


def check_lens(lens: Lens, where: str) -> Lens:
    """Return the lens if it can be one.

    Args:
        lens: what a file says.
        where: name of the camera in the message, e.g. ``camera 1 in cameras.txt``.

    Raises:
        ConfigError: it distorts and pycolmap is not installed.
        UnfitLens: sizes or focal lengths are not positive, numbers are not finite, the image is larger than
            ``MAX_SIDE``, focal lengths are those of no lens, the principal point is farther from the middle
            than ``FARTHEST_CENTER``, or the distortion folds the image or moves its corners out of it.
    """
    fault = _fault(lens)
    if fault is not None:
        message, reason = fault
        raise UnfitLens(message.format(where=where), reason)
    return lens


@lru_cache(maxsize=4096)
def _fault(lens: Lens) -> tuple[str, str] | None:
    """Return why a lens is none: a sentence with a place for its name, and a few words."""
    others = (*lens.center, *lens.distortion, lens.radial_8)
    if not (np.isfinite(lens.focal).all() and min(lens.focal) > 0 and (np.abs(others) <= PIXEL.high).all()):
        return (
            "{where} has no positive, finite focal lengths and centre: calibrate it again",
            "focal lengths and centre not positive and finite",
        )
    height, width = lens.size
    if not (0 < height <= MAX_SIDE and 0 < width <= MAX_SIDE):
        return (
            f"{{where}} is for images of {width}x{height}, and 1 to {MAX_SIDE} pixels a side are read: "
            "shrink the images, and the intrinsics with them",
            f"intrinsics for images that have not 1 to {MAX_SIDE} pixels a side",
        )
    fx, fy = lens.focal
    if min(fx / width, fy / height) < _SHORTEST or max(fx / width, fy / height) > _LONGEST:
        return (
            f"{{where}} has focal lengths of {fx:.4g} and {fy:.4g} pixels for images of {width}x{height}, as "
            "no lens has: calibrate it again",
            "focal lengths that no lens has",
        )
    if center_offset(lens.center, lens.size) > FARTHEST_CENTER:
        return (
            f"{{where}} has its principal point at ({lens.center[0]:.1f}, {lens.center[1]:.1f}), far outside "
            f"of {width}x{height}: give the intrinsics of the stored images",
            "principal point far outside of the image",
        )
    if lens.is_pinhole:
        return None
    if _folds(lens):
        return (
            "the distortion of {where} folds the image onto itself: calibrate it again, or undistort the "
            "images (COLMAP: image_undistorter)",
            "distortion that folds the image",
        )
    if _zoomed(lens) is None:
        return (
            f"the distortion of {{where}} moves the corners out of the image, {_MAX_ZOOM} times as far from "
            "its middle and more, as no lens does: calibrate it again",
            "distortion that moves the corners out of the image",
        )
    return None


def _folds(lens: Lens) -> bool:
    """Whether two points on one ray from the centre, within the image, would be seen at the same place."""
    height, width = lens.size
    (fx, fy), (cx, cy) = lens.focal, lens.center
    corner = float(np.hypot(max(cx, width - cx) / fx, max(cy, height - cy) / fy))
    angle = np.arange(8) * np.pi / 4
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)[:, None]
    radius = np.linspace(0, corner, 129)[:, None]
    # (8, 129): how far from the centre each point is seen, measured along its direction.
    seen = (lens.distort(direction * radius) * direction).sum(axis=-1)
    # NaN, where the model has no image, is not greater than zero either.
    return not bool((np.diff(seen, axis=1) > 0).all())


def pinhole_of(lens: Lens) -> Lens:
    """Return the pinhole camera to which the images of a lens are resampled.

    It has the lens's focal length and centre; if the lens distorts it is zoomed until no corner stays empty.

    Args:
        lens: one that ``check_lens`` accepts.

    Raises:
        ConfigError: it distorts and pycolmap is not installed.
    """
    return lens if lens.is_pinhole else _zoomed(lens) or Lens(lens.size, lens.focal, lens.center)


@lru_cache(maxsize=4096)
def _zoomed(lens: Lens) -> Lens | None:
    """Return the widest pinhole all of whose image the lens shows; None if it takes ``_MAX_ZOOM`` or more."""
    fx, fy = lens.focal
    zoomed = (
        Lens(lens.size, (fx * z, fy * z), lens.center) for z in np.arange(1.0, _MAX_ZOOM, 0.01).tolist()
    )
    return next((pinhole for pinhole in zoomed if _fills(lens, pinhole)), None)


def center_fault(lens: Lens, where: str) -> UnfitLens | None:
    """Return why the principal point shows that intrinsics are of other images, or None.

    Only where most images of a scan have it far from the middle: of a few it is a crop, or wanders.

    Args:
        lens: a camera.
        where: name of the camera in the message.
    """
    (cx, cy), (height, width) = lens.center, lens.size
    stated = other_image_size(lens.center, lens.size)
    if stated is None:
        return None
    turned = ", turned by 90°" if is_turned(stated, lens.size) else ""
    return UnfitLens(
        f"{where} has its principal point at ({cx:.1f}, {cy:.1f}), the middle of {stated[1]}x{stated[0]}"
        f"{turned} and far from that of {width}x{height}: give the intrinsics of the stored images",
        TURNED if turned else "intrinsics for images of another size",
    )


def needs_resampling(lens: Lens, pinhole: Lens) -> bool:
    """Whether a lens's images differ from those of a pinhole camera of the same image size."""
    if lens == pinhole:
        return False
    border = _border(pinhole.size)
    shift = lens.image_of(pinhole, border) - border
    return not float(np.abs(shift).max()) <= _SAME_PX


def resample(image: NDArray[np.uint8], lens: Lens, pinhole: Lens) -> NDArray[np.uint8]:
    """Return what a pinhole camera would have seen, by bilinear interpolation.

    Args:
        image: ``(H, W, 3)`` of the lens, in any size.
        lens: of the image.
        pinhole: with the same pose.

    Returns:
        ``(H, W, 3)``.
    """
    source = torch.from_numpy(image).permute(2, 0, 1)[None].float()
    grid = _sampling_grid(lens, pinhole, (image.shape[0], image.shape[1]))
    sampled = grid_sample(source, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return sampled[0].round().clamp(0, 255).to(torch.uint8).permute(1, 2, 0).numpy()


@lru_cache(maxsize=4)
def _sampling_grid(lens: Lens, pinhole: Lens, size: tuple[int, int]) -> Tensor:
    """Return ``(1, H, W, 2)`` positions in the lens's image, from -1 to 1 between its corners."""
    target = pinhole.scaled_to(size)
    column, row = np.meshgrid(np.arange(size[1]) + 0.5, np.arange(size[0]) + 0.5)
    pixels = lens.image_of(target, np.stack([column, row], axis=-1))
    positions = 2 * pixels / np.array([lens.size[1], lens.size[0]]) - 1
    return torch.from_numpy(np.nan_to_num(positions, nan=2.0).astype(np.float32))[None]


def _fills(lens: Lens, pinhole: Lens) -> bool:
    """Whether the lens's image shows everything that the pinhole sees, up to a pixel."""
    shown = lens.image_of(pinhole, _border(pinhole.size))
    return bool((shown >= -1).all() and (shown <= np.array(lens.size[::-1]) + 1).all())


def _border(size: tuple[int, int]) -> NDArray[np.float64]:
    """Return ``(64, 2)`` points (u, v) along the border of an image."""
    step, height, width = np.arange(16) / 16, size[0], size[1]
    zero, one = np.zeros(16), np.ones(16)
    sides = [(step, zero), (one, step), (1 - step, one), (zero, 1 - step)]
    return np.concatenate([np.stack([u * width, v * height], axis=1) for u, v in sides])


@lru_cache(maxsize=256)
def _unit_camera(model: str, distortion: tuple[float, ...]) -> Any:
    """Return pycolmap's camera of a model with focal length 1 and principal point 0."""
    num_focal = lens_model(model, "a lens").num_focal
    params = [*[1.0] * num_focal, 0.0, 0.0, *distortion]
    return load_pycolmap().Camera(model=model, width=1, height=1, params=params)


@cache
def load_pycolmap(purpose: str = "lenses that distort are computed") -> Any:
    """Import pycolmap.

    Args:
        purpose: what is done by it, for the message if it is not there.

    Raises:
        ConfigError: it is not installed.
    """
    terminate = signal.getsignal(signal.SIGTERM)
    try:
        pycolmap = importlib.import_module("pycolmap")
    except ImportError as error:
        raise ConfigError(
            f"{purpose} by pycolmap, which is not installed: pip install 'raytran[colmap]'"
        ) from error
    # Its import makes SIGTERM print a stack trace in place of what was to happen.
    if terminate is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, terminate)
    return pycolmap
