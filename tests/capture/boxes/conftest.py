# SPDX-License-Identifier: Apache-2.0
"""Two furnished rooms as they were taken, made once."""

from __future__ import annotations

import pytest

from .forms import room_scan


@pytest.fixture(scope="session")
def rooms():
    return [room_scan(number) for number in range(2)]
