# SPDX-License-Identifier: Apache-2.0
"""Where the fused kernels run: on a GPU with Triton. Elsewhere products of ``torch.sparse`` do the work."""

from __future__ import annotations

import logging
import os
from functools import cache
from importlib.util import find_spec

import torch

from raytran.ops.pairs import PairList
from raytran.ops.triton.block_pairs import BlockPairs, kept

MOST_CHANNELS = {torch.float16: 128, torch.bfloat16: 128, torch.float32: 64}
"""Channels of a head up to which the fused kernels fit into a GPU's registers, by the dtype of the inputs."""

_log = logging.getLogger(__name__)


def interpreted() -> bool:
    """Return whether Triton's kernels run in its interpreter: on any device, slowly, to be tested."""
    return os.environ.get("TRITON_INTERPRET") == "1"


def why_no_kernels(device: torch.device) -> str | None:
    """Say why the fused kernels do not run on a device, None where they do."""
    if device.type != "cuda":
        return f"tensors are on the {device.type.upper()}"
    return None if find_spec("triton") is not None else "Triton is not installed"


def fused_blocks(
    pairs: PairList | BlockPairs, device: torch.device, dtype: torch.dtype, channels: int
) -> BlockPairs | None:
    """Return the block pairs for the fused kernels; None, and say once why, where they do not run.

    Args:
        pairs: the pairs; block pairs on a CPU ask for Triton's interpreter, if that is switched on.
        device: of the features.
        dtype: of the features.
        channels: of each head.
    """
    reason = None if interpreted() and isinstance(pairs, BlockPairs) else why_no_kernels(device)
    if isinstance(pairs, PairList) and not pairs.fused:
        reason = "the pairs ask for it"
    elif reason is None and channels > MOST_CHANNELS.get(dtype, 0):
        reason = f"heads have {channels} channels in {dtype}"
    if reason is None:
        return pairs.blocks() if isinstance(pairs, PairList) else pairs
    if not torch.compiler.is_compiling():
        _log_once(logging.WARNING if device.type == "cuda" else logging.DEBUG, reason)
    return None


def listed(pairs: PairList | BlockPairs) -> PairList:
    """Return the pairs as a list; made once and kept."""
    if isinstance(pairs, PairList):
        return pairs
    return kept(pairs, "_listed", lambda: PairList.from_blocks(pairs))


@cache
def _log_once(level: int, reason: str) -> None:
    _log.log(level, "pixels and voxels are joined by torch.sparse and not in fused kernels: %s", reason)
