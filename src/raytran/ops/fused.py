# SPDX-License-Identifier: Apache-2.0
"""Where the fused kernels run: on a GPU with Triton. Elsewhere products of ``torch.sparse`` do the work."""

from __future__ import annotations

import logging
import os
from functools import cache
from importlib.util import find_spec

import torch

from raytran.ops.block_pairs import BlockPairs, kept
from raytran.ops.pairs import PairList

_DTYPES = (torch.float16, torch.bfloat16, torch.float32)

_INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
"""Triton's kernels run on any device, slowly, to be tested; only ``BlockPairs`` ask for that."""

_log = logging.getLogger(__name__)


def has_kernels(device: torch.device) -> bool:
    """Return whether the fused kernels run on a device."""
    return device.type == "cuda" and _has_triton()


def fused_blocks(pairs: PairList | BlockPairs, device: torch.device, dtype: torch.dtype) -> BlockPairs | None:
    """Return the block pairs for the fused kernels; None, and say once why, where they do not run."""
    if device.type != "cuda" and not (_INTERPRETED and isinstance(pairs, BlockPairs)):
        reason = f"tensors are on the {device.type.upper()}"
    elif not _has_triton():
        reason = "Triton is not installed"
    elif dtype not in _DTYPES:
        reason = f"tensors are {dtype}"
    else:
        return pairs.blocks() if isinstance(pairs, PairList) else pairs
    if not torch.compiler.is_compiling():
        _log_once(logging.WARNING if device.type == "cuda" else logging.DEBUG, reason)
    return None


def listed(pairs: PairList | BlockPairs) -> PairList:
    """Return the pairs as a list; made once and kept."""
    if isinstance(pairs, PairList):
        return pairs
    return kept(pairs, "_listed", lambda: PairList.from_blocks(pairs))


def _has_triton() -> bool:
    return find_spec("triton") is not None


@cache
def _log_once(level: int, reason: str) -> None:
    _log.log(level, "pixels and voxels are joined by torch.sparse and not in fused kernels: %s", reason)
