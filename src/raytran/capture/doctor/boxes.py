# SPDX-License-Identifier: Apache-2.0
"""The annotated boxes by themselves: are they as large as furniture, and do they stand upright?"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from raytran.capture.doctor.finding import Finding
from raytran.structs import ObjectSet

_SMALL, _LARGE = 0.08, 8.0
"""Metres between which the median diagonal of a room's objects must lie."""

_LYING_DEG = 35.0
"""Median tilt above which the annotation's axes are wrong; real ones reach five degrees."""

_UNITS = {"centimetres": 0.01, "millimetres": 0.001, "decametres or another large unit": 100.0}


def check_boxes(objects: ObjectSet) -> tuple[ObjectSet, list[Finding]]:
    """Say whether boxes have the size and stance of furniture.

    Args:
        objects: M of them, at least one.

    Returns:
        the objects in metres, and the findings.
    """
    middle = float(objects.size.double().norm(dim=1).median())
    text = f"the median diagonal of {len(objects)} boxes is {middle:.3g}"
    if _SMALL < middle < _LARGE:
        size = Finding("annotation unit", "ok", f"{text} m")
    else:
        name, scale = min(_UNITS.items(), key=lambda unit: abs(np.log(middle * unit[1])))
        fix = f"multiply the annotation's translations and scales by {scale:g}"
        size = Finding("annotation unit", "fault", text, f"annotation in {name}", fix, "certain")
        objects = replace(objects, center=objects.center * scale, size=objects.size * scale)
    tilt = torch.rad2deg(torch.acos(objects.rotation[:, 2, 1].double().clamp(-1, 1)))
    text = f"boxes lean by {float(tilt.median()):.1f}° in the median, at most by {float(tilt.max()):.1f}°"
    if float(tilt.median()) < _LYING_DEG:
        return objects, [size, Finding("objects upright", "ok", text)]
    fix = "it must map CADs with +y up into a world with +z up: see whether a turn is missing or doubled"
    return objects, [size, Finding("objects upright", "fault", text, "objects lie down", fix, "certain")]


def turned(objects: ObjectSet, turn: NDArray[np.float64]) -> ObjectSet:
    """Return objects in a world turned by ``(3, 3)``."""
    matrix = torch.from_numpy(turn).to(objects.center)
    return replace(objects, center=objects.center @ matrix.T, rotation=matrix @ objects.rotation)
