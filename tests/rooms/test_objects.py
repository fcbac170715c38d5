# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from raytran.rooms.objects import Boxes, overlaps


def random_boxes(rng, count, spread):
    return Boxes(
        rng.uniform(-spread, spread, size=(count, 3)),
        Rotation.random(count, rng=rng).as_matrix(),
        rng.uniform(0.1, 1.0, size=(count, 3)),
    )


def share_a_point(a, b):
    """Linear programme: is there a point within all twelve half-spaces?"""
    rows, limits = [], []
    for boxes in (a, b):
        for axis in range(3):
            normal = boxes.axes[0][:, axis]
            middle = normal @ boxes.center[0]
            rows += [normal, -normal]
            limits += [middle + boxes.half[0, axis], boxes.half[0, axis] - middle]
    return linprog(np.zeros(3), A_ub=np.array(rows), b_ub=np.array(limits), bounds=(None, None)).status == 0


def test_agrees_with_a_linear_programme():
    rng = np.random.default_rng(0)
    first, second = random_boxes(rng, 150, 1.0), random_boxes(rng, 150, 1.0)
    answers = []
    for i in range(150):
        a, b = (Boxes(x.center[i : i + 1], x.axes[i : i + 1], x.half[i : i + 1]) for x in (first, second))
        answers.append(bool(overlaps(a, b)[0]))
        assert answers[-1] == share_a_point(a, b)
    assert 30 < sum(answers) < 120


def test_one_against_many_and_margin():
    unit = Boxes.aligned(np.array([[[0.0, 0, 0], [1, 1, 1]]]))
    others = Boxes.aligned(
        np.array([[[1.01, 0, 0], [2, 1, 1]], [[0.9, 0.9, 0.9], [2, 2, 2]], [[0, 0, 3], [1, 1, 4]]])
    )
    assert overlaps(unit, others).tolist() == [False, True, False]
    assert overlaps(unit.grown(0.02), others).tolist() == [True, True, False]


def test_contain():
    turned = Boxes(
        np.zeros((1, 3)), Rotation.from_euler("z", 45, degrees=True).as_matrix()[None], np.ones((1, 3))
    )
    points = np.array([[1.3, 0.0, 0.0], [0.9, 0.9, 0.0], [0.0, 0.0, 1.1]])
    assert turned.contain(points)[:, 0].tolist() == [True, False, False]


def test_corners_of_an_aligned_box():
    bounds = np.array([[[1.0, 2, 3], [2, 4, 6]]])
    corners = Boxes.aligned(bounds).corners()[0]
    assert corners.min(axis=0).tolist() == [1, 2, 3]
    assert corners.max(axis=0).tolist() == [2, 4, 6]
    assert len(np.unique(corners, axis=0)) == 8
