# SPDX-License-Identifier: Apache-2.0
"""What numbers in files can mean."""

from __future__ import annotations

import math

import numpy as np
import pytest

from raytran.errors import DataError
from raytran.limits import BOX_SIDE, POSITION, as_count, as_number, as_numbers, shown

NO_NUMBERS = [
    *(None, "1.0", True, [1.0], {}, b"1", 1j, math.nan, math.inf, -math.inf, 10**400, -(10**400)),
    *(np.bool_(True), np.float64("nan"), 1e300, 10.0**4 + 1, 0.0, -1.0),
]


@pytest.mark.parametrize("value", [1, 1.5, np.float32(2), np.int64(3), 1e-6, 1e4])
def test_number_within_its_bounds_comes_back_as_a_float(value):
    number = as_number(value, BOX_SIDE, "width")
    assert type(number) is float
    assert number == float(value)


@pytest.mark.parametrize("value", NO_NUMBERS)
def test_what_is_no_length_ends_in_one_short_sentence(value):
    with pytest.raises(
        DataError, match=r"width of box 3 is .*, not a length in metres of 1e-06 to 10000"
    ) as e:
        as_number(value, BOX_SIDE, "width of box 3")
    assert len(str(e.value)) < 200
    assert "\n" not in str(e.value)


def test_counts_are_whole():
    assert [as_count(value, 0, 10, "views") for value in (0, 4.0, np.int8(10))] == [0, 4, 10]
    for value in (4.5, "4", True, None, -1, 11, math.nan, math.inf, 10**5000):
        with pytest.raises(DataError, match=r"views is .*, not a whole number from 0 to 10"):
            as_count(value, 0, 10, "views")


def test_arrays_have_their_shape_and_bounds():
    rows = [[1, 2.5, -3], [4, 5, 6]]
    np.testing.assert_array_equal(as_numbers(rows, (-1, 3), POSITION, "centres"), rows)
    np.testing.assert_array_equal(as_numbers(range(6), (2, 3), POSITION, "centres"), [[0, 1, 2], [3, 4, 5]])
    for value in (
        [1, 2],
        [[1, 2], [3]],
        "abc",
        None,
        [None] * 3,
        ["1"] * 3,
        [True] * 3,
        [10**400] * 3,
        {"a": 1},
    ):
        with pytest.raises(DataError, match="centres does not hold nx3 numbers"):
            as_numbers(value, (-1, 3), POSITION, "centres")
    for value in (math.nan, math.inf, 1e7):
        with pytest.raises(DataError, match=r"centres holds .*, not a position of -1e\+06 to 1e\+06"):
            as_numbers([0, value, 0], (-1, 3), POSITION, "centres")


def test_lost_numbers_are_not_a_number():
    lost = as_numbers([1, math.nan, math.inf, 1e300], (4,), POSITION, "centres", lost=True)
    np.testing.assert_array_equal(lost, [1, math.nan, math.nan, math.nan])


def test_wrong_values_are_shown_in_one_line():
    assert shown(10**5000) == "a whole number of more than 30 digits"
    assert all(
        len(shown(value)) <= 40 for value in ("x" * 10**6, list(range(10**5)), {i: i for i in range(99)})
    )
    assert shown("a\nb\x1b\ud800") == r"'a\nb\x1b\ud800'"
