# SPDX-License-Identifier: Apache-2.0
"""Overlap of oriented boxes by the separating-axis test, one box against many."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)


@dataclass(frozen=True)
class Boxes:
    """``n`` oriented boxes.

    Attributes:
        center: ``(n, 3)`` metres.
        axes: ``(n, 3, 3)``; the columns are the unit axes.
        half: ``(n, 3)`` half extents along the axes, metres.
    """

    center: NDArray[np.float64]
    axes: NDArray[np.float64]
    half: NDArray[np.float64]

    @staticmethod
    def aligned(bounds: NDArray[np.float64]) -> Boxes:
        """Return the boxes of axis-aligned bounds ``(n, 2, 3)`` (lower, upper)."""
        lower, upper = bounds[:, 0], bounds[:, 1]
        return Boxes((lower + upper) / 2, np.tile(np.eye(3), (len(bounds), 1, 1)), (upper - lower) / 2)

    @staticmethod
    def joined(parts: list[Boxes]) -> Boxes:
        """Return all boxes of ``parts``, in order."""
        return Boxes(
            np.concatenate([part.center for part in parts]),
            np.concatenate([part.axes for part in parts]),
            np.concatenate([part.half for part in parts]),
        )

    def __len__(self) -> int:
        return len(self.center)

    def grown(self, margin: float) -> Boxes:
        """Return the boxes with every side pushed outwards by ``margin`` metres."""
        return Boxes(self.center, self.axes, self.half + margin)

    def corners(self) -> NDArray[np.float64]:
        """Return ``(n, 8, 3)``."""
        return self.center[:, None] + np.einsum("nij,nkj->nki", self.axes, _SIGNS * self.half[:, None])

    def contain(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return ``(m, n)``: is each of the points ``(m, 3)`` inside each box."""
        local = np.einsum("mni,nij->mnj", points[:, None] - self.center, self.axes)
        return (np.abs(local) <= self.half).all(axis=-1)


def overlaps(box: Boxes, others: Boxes) -> NDArray[np.bool_]:
    """Return ``(n,)``: does the single ``box`` share volume with each of ``others``.

    The separating-axis test over the 3 + 3 face normals and the 9 products of edges (Gottschalk et al. 1996).
    """
    turn = np.einsum("ji,njk->nik", box.axes[0], others.axes)
    shift = (others.center - box.center[0]) @ box.axes[0]
    absolute = np.abs(turn) + 1e-9
    a, b = box.half[0], others.half
    apart = (np.abs(shift) > a + np.einsum("nij,nj->ni", absolute, b)).any(axis=1)
    in_other = np.einsum("ni,nij->nj", shift, turn)
    apart |= (np.abs(in_other) > np.einsum("i,nij->nj", a, absolute) + b).any(axis=1)
    for i in range(3):
        i1, i2 = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            j1, j2 = (j + 1) % 3, (j + 2) % 3
            reach_a = a[i1] * absolute[:, i2, j] + a[i2] * absolute[:, i1, j]
            reach_b = b[:, j1] * absolute[:, i, j2] + b[:, j2] * absolute[:, i, j1]
            distance = np.abs(shift[:, i2] * turn[:, i1, j] - shift[:, i1] * turn[:, i2, j])
            apart |= distance > reach_a + reach_b
    return ~apart
