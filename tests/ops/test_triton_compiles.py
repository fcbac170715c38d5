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

from raytran.ops.block_attention import block_attention
from raytran.ops.pairs import PairList

generator = torch.Generator().manual_seed(0)
for views in (2, 35):
    pixel, voxel = (torch.rand(views * 64, 128, generator=generator) < 0.1).nonzero(as_tuple=True)
    pairs = PairList(pixel, voxel, views * 64, 128, (views, 4, 16), (1, 8, 4, 4))
    for to_voxels in (True, False):
        sizes = (128, views * 64, views * 64) if to_voxels else (views * 64, 128, 128)
        inputs = [torch.zeros(n, 2, 32, dtype=torch.bfloat16, requires_grad=True) for n in sizes]
        block_attention(*inputs, pairs.blocks(), to_voxels=to_voxels).sum().backward()
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
    # Once for either direction: 2 and 35 views use the same code.
    assert {name: codes for name, (codes, _) in found.items()} == dict.fromkeys(
        (
            "attend_forward",
            "attend_backward_targets",
            "attend_backward_sources",
            "merge_forward",
            "merge_sums",
        ),
        2,
    )
    assert all((products > 0) == ("attend" in name) for name, (_, products) in found.items())  # tensor cores
