# SPDX-License-Identifier: Apache-2.0
"""Box IoU against exact rational arithmetic, over the kinds of pairs on which other implementations fail.

The oracle is Lasserre's formula for the volume of {x : Ax ≤ b}, a recursion over half-spaces in whole
numbers: it knows neither corners nor clipping.
"""

from __future__ import annotations

import zlib
from fractions import Fraction
from math import lcm

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from raytran.geometry.boxes import OrientedBoxes, _box_iou, box_iou

PAIRS = 3
Row = tuple[int, ...]  # a_1 … a_d, b of one half-space, whole numbers, any positive scale
Box = tuple[np.ndarray, np.ndarray, np.ndarray]  # centre, size, rotation


def half_spaces(center, size, rotation) -> list[Row]:
    """The six half-spaces ± n_i · (x - c) ≤ |det| of a box, exact."""
    m = [[Fraction(float(rotation[i, j])) * Fraction(float(size[j])) / 2 for j in range(3)] for i in range(3)]
    x, y, z = ([m[i][j] for i in range(3)] for j in range(3))

    def cross(u, v):
        return [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]

    c = [Fraction(float(value)) for value in center]
    rows = []
    determinant = abs(sum(p * q for p, q in zip(x, cross(y, z), strict=True)))
    for normal in (cross(y, z), cross(z, x), cross(x, y)):
        along = sum(p * q for p, q in zip(normal, c, strict=True))
        for sign in (1, -1):
            row = [*(sign * value for value in normal), determinant + sign * along]
            scale = lcm(*(value.denominator for value in row))
            rows.append(tuple(int(value * scale) for value in row))
    return rows


def lasserre(rows: list[Row]) -> Fraction:
    """Volume of the bounded polytope of half-spaces: V = 1/d · Σ_i b_i / |a_ij| · V(facet i without x_j)."""
    kept: dict[tuple[Fraction, ...], Row] = {}
    for row in rows:
        pivot = next((value for value in row[:-1] if value), None)
        if pivot is None:
            if row[-1] < 0:
                return Fraction(0)
            continue
        kept.setdefault((*(Fraction(value, abs(pivot)) for value in row),), row)
    rows, d = list(kept.values()), len(rows[0]) - 1
    if d == 1:
        upper = min(Fraction(b, a) for a, b in rows if a > 0)
        lower = max(Fraction(b, a) for a, b in rows if a < 0)
        return max(upper - lower, Fraction(0))
    total = Fraction(0)
    for i, facet in enumerate(rows):
        if facet[-1] == 0:
            continue
        j = max(range(d), key=lambda k: abs(facet[k]))
        size, sign = abs(facet[j]), 1 if facet[j] > 0 else -1
        reduced = [
            tuple(row[k] * size - sign * row[j] * facet[k] for k in range(d + 1) if k != j)
            for n, row in enumerate(rows)
            if n != i
        ]
        total += Fraction(facet[-1], size) * lasserre(reduced)
    return total / d


def volume(box: Box) -> Fraction:
    return lasserre([shifted(row, box[0]) for row in half_spaces(*box)])


def shifted(row: Row, center: np.ndarray) -> Row:
    """The half-space seen from ``center``, which keeps the numbers short."""
    b = row[-1] - sum(Fraction(float(c)) * a for a, c in zip(row[:-1], center, strict=True))
    return tuple(int(value * b.denominator) for value in (*row[:-1], b))


def exact_iou(a: Box, b: Box) -> float:
    if min(*a[1], *b[1]) == 0:
        return 0.0
    shared = lasserre([shifted(row, a[0]) for row in half_spaces(*a) + half_spaces(*b)])
    return float(shared / (volume(a) + volume(b) - shared))


def turn(rng, degrees=None) -> np.ndarray:
    axis = rng.normal(size=3)
    angle = rng.uniform(0, 180) if degrees is None else degrees
    return Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.radians(angle)).as_matrix()


def yaw(angle: float) -> np.ndarray:
    return Rotation.from_rotvec([0, 0, angle]).as_matrix()


def anywhere(rng) -> Box:
    return rng.uniform(-3, 3, 3), rng.uniform(0.3, 2, 3), turn(rng)


def moved(box: Box, shares: np.ndarray, *, scale=1.0, rotation=None) -> Box:
    """The box moved by shares of its own size."""
    center, size, r = box
    return center + r @ (np.asarray(shares) * size), size * scale, r if rotation is None else rotation @ r


def detection(rng, box: Box, tilt: float) -> Box:
    noise = rng.normal(size=3)
    return box[0] + 0.05 * noise, box[1] * rng.uniform(0.9, 1.1, 3), turn(rng, tilt) @ box[2]


def coplanar(rng) -> tuple[Box, Box]:
    """Same axes, one common face plane, on dyadic numbers so that the plane is exactly common."""
    r = np.eye(3)[:, rng.permutation(3)]
    a = (np.zeros(3), np.array([1.0, 1.5, 0.75]), r)
    shift, size = rng.integers(-6, 7, 3) / 16, rng.integers(4, 33, 3) / 16
    shift[0] = (1.0 - size[0]) / 2
    return a, (r @ shift, size, r)


def make_pair(kind: str, rng: np.random.Generator) -> tuple[Box, Box]:
    a = anywhere(rng)
    upright = (a[0], a[1], yaw(rng.uniform(0, 6)))
    square = (a[0], a[1], np.eye(3))
    near = rng.uniform(-0.4, 0.4, 3)
    touch = {"touch_face": [1, 0.2, 0.1], "touch_edge": [1, 1, 0.3], "touch_corner": [1, -1, 1]}
    if kind in touch:
        unit = (np.zeros(3), np.array([0.5, 1.0, 2.0]), np.eye(3))
        return unit, moved(unit, np.array(touch[kind]) * rng.choice([-1, 1], 3))
    thin, small = a[1] * [1, 1e-3, 1], np.full(3, 0.01)
    needle, far = np.array([10, 0.01, 0.01]), rng.choice([-1e3, 1e3], 3)
    tiny_turn = turn(rng, np.degrees(10.0 ** rng.uniform(-14, -4)))
    pairs = {
        "generic": lambda: (a, moved(a, near, rotation=turn(rng))),
        "detection": lambda: (a, detection(rng, a, rng.uniform(0, 15))),
        "yaw_only": lambda: (upright, moved(upright, near, rotation=yaw(rng.uniform(0, 6)))),
        "axis_aligned": lambda: (square, moved(square, near, scale=rng.uniform(0.5, 2, 3))),
        "contained": lambda: (a, moved(a, near / 4, scale=0.3, rotation=turn(rng))),
        "identical": lambda: (a, a),
        "disjoint_near": lambda: (a, moved(a, [1.01, 0, 0], rotation=turn(rng, 0.1))),
        "coplanar": lambda: coplanar(rng),
        "tiny_1cm": lambda: ((a[0], small, a[2]), detection(rng, (a[0] - 0.04, small, a[2]), 10)),
        "tiny_1cm_near": lambda: ((a[0], small, a[2]), (a[0] + 0.002, small * 1.1, turn(rng, 5) @ a[2])),
        "thin_plate": lambda: (
            (a[0], thin, a[2]),
            moved((a[0], thin, a[2]), near / 4, rotation=turn(rng, 0.05)),
        ),
        "large_offset": lambda: (
            moved(a, far / a[1]),
            moved(moved(a, far / a[1]), near, rotation=turn(rng, 20)),
        ),
        "perm_90": lambda: (a, moved(a, near / 8, rotation=a[2] @ np.eye(3)[[1, 2, 0]] @ a[2].T)),
        "near_parallel": lambda: (a, moved(a, [0, 0, 0], rotation=tiny_turn)),
        "near_parallel_slid": lambda: (a, moved(a, [0.3, 0, 0], scale=1.03, rotation=tiny_turn)),
        "small_tilt": lambda: (a, detection(rng, a, rng.uniform(0.06, 3.6))),
        "needle": lambda: ((a[0], needle, a[2]), (a[0] + 1e-3, needle, turn(rng, 0.01) @ a[2])),
        "zero_size": lambda: (a, (a[0], a[1] * [1, 0, 1], a[2])),
        "zero_line": lambda: (a, (a[0], a[1] * [0, 1, 0], a[2])),
        "zero_both": lambda: ((a[0], a[1] * [1, 1, 0], a[2]), (a[0], a[1] * [1, 1, 0], a[2])),
        "mirrored": lambda: (a, moved(a, near, rotation=turn(rng, 30) @ np.diag([1.0, 1.0, -1.0]))),
    }
    return pairs[kind]()


KINDS = (
    *(
        "generic",
        "detection",
        "yaw_only",
        "axis_aligned",
        "contained",
        "identical",
        "disjoint_near",
        "coplanar",
    ),
    *("touch_face", "touch_edge", "touch_corner", "tiny_1cm", "tiny_1cm_near", "thin_plate", "large_offset"),
    *("perm_90", "near_parallel", "near_parallel_slid", "small_tilt", "needle"),
    *("zero_size", "zero_line", "zero_both", "mirrored"),
)


def make_pairs(kind: str, count: int = PAIRS) -> list[tuple[Box, Box]]:
    rng = np.random.default_rng(zlib.crc32(kind.encode()))
    return [make_pair(kind, rng) for _ in range(count)]


def stack(boxes: list[Box], dtype: torch.dtype = torch.float64) -> OrientedBoxes:
    return OrientedBoxes(*(torch.from_numpy(np.stack(part)).to(dtype) for part in zip(*boxes, strict=True)))


def check_exact(pairs: list[tuple[Box, Box]]) -> None:
    first, second = (stack(list(side)) for side in zip(*pairs, strict=True))
    expected = torch.tensor([exact_iou(a, b) for a, b in pairs], dtype=torch.float64)
    iou, shared = box_iou(first, second)
    swapped, _ = box_iou(second, first)
    torch.testing.assert_close(iou.diagonal(), expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(swapped.diagonal(), expected, rtol=0, atol=1e-12)
    for values in (iou, swapped):
        assert values.isfinite().all()
        assert ((values >= 0) & (values <= 1)).all()
    assert (shared >= 0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_iou_is_exact(kind):
    check_exact(make_pairs(kind))


@pytest.mark.parametrize("exponent", range(-14, -3))
@pytest.mark.parametrize("slid", [0.0, 0.3, 1.0])
def test_nearly_parallel_faces(exponent, slid):
    """Turned by 1e-14 to 1e-4 rad: in place, along a common plane, and face to face."""
    rng = np.random.default_rng(100 + exponent)
    a = anywhere(rng)
    b = moved(a, [slid, 0, 0], rotation=turn(rng, np.degrees(10.0**exponent)))
    check_exact([(a, b), (moved(a, 1e3 / a[1]), moved(b, 1e3 / b[1]))])


@pytest.mark.parametrize("degrees", [0.06, 0.25, 1.0, 2.0, 3.6])
def test_small_tilts_of_boxes_of_almost_one_size(degrees):
    """Where clipping with a tolerance on coplanar faces errs most."""
    rng = np.random.default_rng(int(100 * degrees))
    boxes = [anywhere(rng) for _ in range(4)]
    check_exact([(a, moved(a, [0.01, 0, 0], scale=1.03, rotation=turn(rng, degrees))) for a in boxes])


def test_oracle_knows_closed_forms():
    cube = (np.zeros(3), np.ones(3), np.eye(3))
    assert exact_iou(cube, (np.array([0.5, 0, 0]), np.ones(3), np.eye(3))) == 1 / 3
    assert exact_iou(cube, (np.zeros(3), np.full(3, 0.5), np.eye(3))) == 1 / 8
    octagon = 2 * (np.sqrt(2) - 1)
    assert exact_iou(cube, (np.zeros(3), np.ones(3), yaw(np.pi / 4))) == pytest.approx(
        octagon / (2 - octagon)
    )


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_finite(kind):
    sides = [stack(list(side)) for side in zip(*make_pairs(kind), strict=True)]
    tensors = [t.requires_grad_() for box in sides for t in (box.center, box.size, box.rotation)]
    iou, shared = box_iou(*sides)
    (iou.sum() + shared.sum()).backward()
    assert all(t.grad is not None and t.grad.isfinite().all() for t in tensors)


@pytest.mark.parametrize(
    "kind", ["generic", "detection", "contained", "tiny_1cm_near", "large_offset", "small_tilt", "mirrored"]
)
def test_gradients_match_differences(kind):
    """Along random directions; in the other kinds the IoU has a kink at the pair itself."""
    rng = np.random.default_rng(3)
    for a, b in make_pairs(kind):
        offset = b[0] - a[0]  # near the origin, where a difference of centres is exact enough
        values = [torch.from_numpy(v.copy()) for v in (np.zeros(3), a[1], a[2], offset, b[1], b[2])]
        scale = float(min(*a[1], *b[1]))
        steps = [scale * torch.from_numpy(rng.normal(size=v.shape)) for v in values]
        steps[2], steps[5] = steps[2] / scale, steps[5] / scale

        def iou(share, values=values, steps=steps):
            at = [value + share * step for value, step in zip(values, steps, strict=True)]
            boxes = [OrientedBoxes(*(v[None] for v in at[k : k + 3])) for k in (0, 3)]
            return box_iou(*boxes)[0].sum()

        slope = torch.autograd.functional.jacobian(iou, torch.zeros((), dtype=torch.float64))
        difference = (iou(torch.tensor(1e-6)) - iou(torch.tensor(-1e-6))) / 2e-6
        torch.testing.assert_close(slope, difference.double(), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_single_precision_fallback(kind):
    near_origin = [
        tuple((c - a[0], s, r) for c, s, r in (a, b)) for a, b in make_pairs(kind)
    ]  # MPS computes in float32
    sides = [stack(list(side), torch.float32) for side in zip(*near_origin, strict=True)]
    single, _ = _box_iou(*sides, torch.float32)
    double, _ = box_iou(*sides)
    tolerance = 1e-4 if kind in ("thin_plate", "needle", "near_parallel", "near_parallel_slid") else 2e-6
    assert single.dtype == torch.float32
    assert (single - double).diagonal().abs().max() <= tolerance
