# SPDX-License-Identifier: Apache-2.0
"""Fixtures for all tests."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

if not torch.cuda.is_available():
    # Without a GPU Triton's kernels run in its interpreter. Triton reads this when it is first imported.
    os.environ["TRITON_INTERPRET"] = "1"

PROJECT_ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def project_root() -> Path:
    return PROJECT_ROOT


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder of reference material beside the project; tests that read it skip when it is absent."""
    folder = PROJECT_ROOT.parent / "shared"
    if not (folder / "realdata").is_dir():
        pytest.skip(f"reference data not found at {folder / 'realdata'}")
    return folder


@pytest.fixture(autouse=True)
def log_levels_are_left_alone() -> Iterator[None]:
    """What one test silences, others would wait for in vain."""
    log = logging.getLogger("raytran")
    before = log.level, log.disabled
    yield
    after = log.level, log.disabled
    log.setLevel(before[0])
    log.disabled = before[1]
    assert after == before, "the test leaves the logger of raytran changed"


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)
