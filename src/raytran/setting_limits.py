# SPDX-License-Identifier: Apache-2.0
"""What numbers in settings can mean, by the names that the settings have in every command and in the API.

A typing mistake, or a file from elsewhere, may ask for images of no pixels, a billion frames or a learning
rate that is no number. All of these end here, in one sentence, before memory is taken or work begun.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from raytran.errors import ConfigError
from raytran.limits import (
    BOX_SIDE,
    MAX_SIDE,
    MAX_STEPS,
    MAX_VIEWS,
    SCALE,
    SHARE,
    Quantity,
    as_count,
    as_number,
)

MAX_CELLS_A_SIDE = 2048
MAX_CELLS = 2**26
"""Most voxels along a side of a grid and in all of it: their features alone have 64 GB then."""

_ROOMS = 1_000_000
_PROCESSES = 4096

_COUNTS: dict[str, tuple[int, int]] = {
    # images and frames
    **dict.fromkeys(("image_size", "feature_size"), (1, MAX_SIDE)),
    **dict.fromkeys(
        ("num_views", "predict_views", "val_views", "views_at_once", "min_views"), (1, MAX_VIEWS)
    ),
    **dict.fromkeys(("frames", "max_frames"), (1, MAX_VIEWS)),
    **dict.fromkeys(("new_views", "num_new_views", "num_overlays"), (0, MAX_VIEWS)),
    "longest_side": (64, MAX_SIDE),
    "turntable": (0, 1000),
    # the network
    **dict.fromkeys(("grid_resolution", "resolution"), (1, MAX_CELLS_A_SIDE)),
    "rays_per_cell": (1, 64),
    **dict.fromkeys(("channels", "width", "widths", "hidden"), (1, 65_536)),
    "num_heads": (1, 1024),
    **dict.fromkeys(("num_blocks", "num_layers", "num_levels"), (1, 1000)),
    "num_queries": (1, 10_000),
    "num_copies": (0, 1000),
    # training
    "steps": (1, MAX_STEPS),
    "max_steps": (-1, MAX_STEPS),
    **dict.fromkeys(
        ("checkpoint_every", "validate_every", "log_every", "val_check_interval"), (1, MAX_STEPS)
    ),
    "warmup_steps": (0, MAX_STEPS),
    **dict.fromkeys(("batch", "batch_size", "accumulate_grad_batches"), (1, 1_000_000)),
    **dict.fromkeys(("num_workers", "processes"), (0, _PROCESSES)),
    "seed": (0, 2**32 - 1),
    "num_nodes": (1, 100_000),
    # data and scores
    **dict.fromkeys(("num_train", "num_val", "num_test"), (0, _ROOMS)),
    **dict.fromkeys(("min_objects", "max_objects"), (0, 1000)),
    "max_scenes": (1, _ROOMS),
    "checks": (1, _ROOMS),
    "num_resamples": (1, 100_000),
}
"""Least and largest value of each whole number."""

_FACTOR = Quantity("a factor", 0, 1e6)
_POSITIVE = Quantity("a positive factor", 1e-9, 1e9)
_DEGREES = Quantity("an angle in degrees", 0, 360)

_NUMBERS: dict[str, Quantity] = {
    **dict.fromkeys(("grid_extent", "extent", "volume_extent"), BOX_SIDE),
    "room_size": Quantity("a length in metres", 1, 1000),
    "norm_momentum": SHARE,
    "scale": SCALE,
    **dict.fromkeys(("camera_height", "distance"), Quantity("a length in metres", 0, 1000)),
    "ceilings": _POSITIVE,
    **dict.fromkeys(("learning_rate", "weight_decay", "gradient_clip", "gradient_clip_val"), _FACTOR),
    **dict.fromkeys(("score_threshold", "duplicate_iou", "mirror", "frame_dropout"), SHARE),
    **dict.fromkeys(("brightness", "contrast", "saturation"), SHARE),
    **dict.fromkeys(("yaw_deg", "hue_deg"), _DEGREES),
    "shift": Quantity("a length in metres", 0, 1e4),
    "mesh_error": Quantity("a length in metres", 0, 1),
    "weights": _FACTOR,
    **dict.fromkeys(("no_object_weight", "parent_minimum"), _FACTOR),
    **dict.fromkeys(("center_beta", "yaw_beta"), _POSITIVE),
}
"""What each other number measures."""

_MAX_DEPTH = 50


def is_a_number(name: str) -> bool:
    """Return whether a setting of this name is a number in every command."""
    return name in _COUNTS or name in _NUMBERS


def check_settings(settings: Mapping[str, Any], *, where: str = "") -> None:
    """Raise unless every number in settings lies within the bounds of what it means.

    Args:
        settings: values, lists of them and further settings by name; those that are no numbers, as words and
            references in a config, are not looked at, nor are those whose meaning is not known here.
        where: what to put before their names.

    Raises:
        ConfigError: one does not; the sentence has its name.
    """
    _check(settings, "", where, _MAX_DEPTH)


def _check(value: Any, name: str, path: str, depth: int) -> None:
    if depth == 0:
        raise ConfigError(f"{path[:80]} holds settings nested too deeply: mend it")
    if isinstance(value, Mapping):
        for key, part in value.items():
            # Below "weights" stand the terms of a loss, by name.
            meaning = name if name == "weights" else str(key)
            _check(part, meaning, f"{path}.{key}" if path else str(key), depth - 1)
    elif isinstance(value, list | tuple):
        for part in value:
            _check(part, name, path, depth - 1)
    elif _is_number(value):
        if name in _COUNTS:
            as_count(value, *_COUNTS[name], path, error=ConfigError)
        elif name in _NUMBERS:
            as_number(value, _NUMBERS[name], path, error=ConfigError)


def _is_number(value: Any) -> bool:
    """Say whether a value is a number, or a text that only looks as one: then it is none in the end."""
    if not isinstance(value, str):
        return isinstance(value, int | float)
    try:
        float(value)
    except ValueError:
        return False
    return True
