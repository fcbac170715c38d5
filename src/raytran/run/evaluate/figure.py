# SPDX-License-Identifier: Apache-2.0
"""The figure of accuracy against the thresholds, of one result or with those of earlier ones."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from raytran.errors import ConfigError
from raytran.pictures.accuracy_curves import FILE, draw_accuracy_curves

Curves = Mapping[str, Any]
"""What ``AccuracyCurves.compute`` returns."""


def read_curves(folders: Iterable[str | Path]) -> dict[str, Curves]:
    """Return the curves of earlier results, by the folder as it was given.

    Args:
        folders: each with a ``metrics.json`` that ``evaluate`` wrote.

    Raises:
        ConfigError: one has none, or no curves in it.
    """
    found: dict[str, Curves] = {}
    for folder in folders:
        path = Path(folder) / "metrics.json"
        try:
            curves = json.loads(path.read_text(encoding="utf-8"))["strict"]["curves"]
            _check(curves)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ConfigError(
                f"{path} has no curves of protocol strict to draw ({type(error).__name__}): draw_with= takes "
                "folders that raytran.evaluate wrote with protocol=strict or all, or for a checkpoint"
            ) from error
        found[str(folder)] = curves
    return found


def draw_figure(folder: Path, name: str, curves: Curves, others: Mapping[str, Curves]) -> Path:
    """Write ``accuracy_curves.png``.

    Args:
        folder: to write to.
        name: of the result.
        curves: its own.
        others: by name, to be drawn beside; may be empty.

    Returns:
        The file.
    """
    return draw_accuracy_curves(folder / FILE, {name: curves, **others})


def _check(curves: Curves) -> None:
    for curve in ("translation", "rotation", "scale", "joint"):
        lengths = {
            len([float(value) for value in curves[curve][name]]) for name in ("threshold", "class_average")
        }
        if len(lengths) != 1 or 0 in lengths:
            raise ValueError(curve)
