# SPDX-License-Identifier: Apache-2.0
"""The fused kernels go through Triton's compiler for a GPU that need not be there."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

pytest.importorskip("triton", reason="Triton is not installed: there is no compiler to ask")

_SCRIPT = '''
import torch, triton
from triton.backends.compiler import GPUTarget
from triton.runtime import JITFunction, driver

class NoGpu:
    """A driver that has a target to compile for and nothing to run on."""

    def get_current_device(self): return 0
    def get_current_stream(self, device=0): return 0
    def get_current_target(self): return GPUTarget("cuda", 90, 32)

driver.set_active(NoGpu())
compiled = {}
run = JITFunction.run

def compile_only(self, *args, grid, warmup, **options):
    kernel = run(self, *args, grid=grid, warmup=True, **options)
    compiled.setdefault(self.fn.__name__, set()).add(kernel.asm["ptx"])

JITFunction.run = compile_only
triton.autotune = lambda *_, **__: lambda kernel: kernel

from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops.block_attention import block_attention
from raytran.ops.block_sum import block_sum
from raytran.ops.pairs import PairList
from raytran.ops.trace_blocks import trace_blocks

generator = torch.Generator().manual_seed(0)
for views in (2, 35):
    pixel, voxel = (torch.rand(views * 64, 128, generator=generator) < 0.1).nonzero(as_tuple=True)
    pairs = PairList(pixel, voxel, views * 64, 128, (views, 4, 16), (1, 8, 4, 4))
    for to_voxels in (True, False):
        sizes = (128, views * 64, views * 64) if to_voxels else (views * 64, 128, 128)
        inputs = [torch.zeros(n, 2, 32, dtype=torch.bfloat16, requires_grad=True) for n in sizes]
        block_attention(*inputs, pairs.blocks(), to_voxels=to_voxels)[0].sum().backward()
    features = torch.zeros(views * 64, 32, dtype=torch.bfloat16, requires_grad=True)
    block_sum(features, pairs.blocks()).sum().backward()
    cameras = Cameras(torch.eye(3).expand(views, 3, 3), torch.eye(4).expand(views, 4, 4), (64, 256))
    trace_blocks(cameras, VoxelGrid((8, 4, 4), (8.0, 4.0, 4.0), torch.zeros(3)), (4, 16), 2, capacity=1024)
for name, codes in compiled.items():
    products = [code.count("mma.sync") + code.count("wgmma.mma_async") for code in codes]
    print(name, len(codes), min(products))
'''


@pytest.mark.slow
def test_kernels_compile_for_a_hopper_gpu_and_once_for_any_number_of_views():
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    result = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", _SCRIPT],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    found = {
        name: (int(codes), int(products))
        for name, codes, products in map(str.split, result.stdout.splitlines())
    }
    # Once for either direction, and block_sum's once for either dtype: 2 and 35 views use the same code.
    attention = ("attend_forward", "attend_backward_targets", "attend_backward_sources", "sum_boxes")
    traversal = ("touch_blocks", "list_blocks", "mask_blocks")
    assert {name: codes for name, (codes, _) in found.items()} == {
        **dict.fromkeys((*attention, "merge_forward"), 2),
        "merge_sums": 4,
        **dict.fromkeys(traversal, 1),
    }
    for name in attention[:3]:
        assert found[name][1] > 0  # products on tensor cores
