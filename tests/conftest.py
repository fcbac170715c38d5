# SPDX-License-Identifier: Apache-2.0
"""Fixtures for all tests."""

from __future__ import annotations

import os
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


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)
