# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch

from raytran.errors import ConfigError
from raytran.heads.auxiliary import ForegroundHead
from raytran.heads.shape import ShapeHead


def test_cells_are_63_a_side() -> None:
    head = ShapeHead(channels=8, widths=(16, 8, 8, 4))
    assert head(torch.randn(2, 8)).shape == (2, 63, 63, 63)
    assert head(torch.randn(0, 8)).shape == (0, 63, 63, 63)


def test_an_object_does_not_depend_on_the_others() -> None:
    head = ShapeHead(channels=8, widths=(16, 8, 8, 4))
    embedding = torch.randn(3, 8)
    torch.testing.assert_close(head(embedding)[1], head(embedding[1:2])[0])


@pytest.mark.parametrize("widths", [(), (16, 8, 8, 3), (5, 8, 8, 4)])
def test_widths_that_cannot_be_normalised_are_told(widths) -> None:
    for make in (ShapeHead, ForegroundHead):
        with pytest.raises(ConfigError, match="each divisible by 4"):
            make(channels=8, widths=widths)
