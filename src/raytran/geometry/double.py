# SPDX-License-Identifier: Apache-2.0
"""Where what takes float64 is computed: Apple's GPUs have none, nor products of sparse matrices."""

from __future__ import annotations

import torch

WITHOUT_DOUBLE = {"mps"}
"""Kinds of devices that have neither."""


def has_double(device: torch.device) -> bool:
    """Say whether a device computes in float64, and with sparse matrices."""
    return device.type not in WITHOUT_DOUBLE


def widest(device: torch.device) -> torch.dtype:
    """Return float64, or float32 on a device that lacks it."""
    return torch.float64 if has_double(device) else torch.float32


def place_with_double(device: torch.device) -> torch.device:
    """Return the device itself, or the CPU for one that lacks float64: tensors then go there and back."""
    return device if has_double(device) else torch.device("cpu")
