# SPDX-License-Identifier: Apache-2.0
"""Send every kernel through Triton's compiler for a GPU that need not be there.

``python compile_kernels.py CAPABILITY [DTYPE:CHANNELS[:both] …]`` prints a line of JSON for each variant
compiled: what it is, and the registers, stack and shared memory that ``ptxas`` gave it. Targets are voxels,
with ``both`` pixels too. A process of its own, because Triton decides at its import whether kernels are
compiled or interpreted. Works with Triton 3.4 to 3.9.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

os.environ.pop("TRITON_INTERPRET", None)

import torch
from triton.backends import nvidia
from triton.backends.compiler import GPUTarget
from triton.runtime import JITFunction, driver

from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid
from raytran.ops.pairs import PairList
from raytran.ops.triton.attention import block_attention
from raytran.ops.triton.sum import block_sum
from raytran.ops.triton.traverse import trace_blocks

FEATURE_SIZE, RESOLUTION, EXTENT, CHANNELS = (30, 40), (48, 48, 16), (9.0, 9.0, 3.5), 256
"""Those of the paper."""


class NoGpu:
    """A driver that has a target to compile for and nothing to run on."""

    def __init__(self, capability: int) -> None:
        self._target = GPUTarget("cuda", capability, 32)

    def get_current_device(self) -> int:
        return 0

    def get_current_stream(self, device: int = 0) -> int:
        return 0

    def get_current_target(self) -> GPUTarget:
        return self._target


class Compilation:
    """Stands in for launching a kernel: compiles it, and prints what came out the first time."""

    def __init__(self) -> None:
        self.case = ""
        self._known: set[tuple[str, str]] = set()
        self._run = JITFunction.run

    def __call__(self, kernel: JITFunction, *arguments: Any, grid: Any, warmup: bool, **options: Any) -> Any:
        compiled = self._run(kernel, *arguments, grid=grid, warmup=True, **options)
        name = kernel.fn.__name__
        if (name, compiled.hash) not in self._known:
            self._known.add((name, compiled.hash))
            found = {"kernel": name, "case": self.case, "warps": compiled.metadata.num_warps}
            products = sum(
                compiled.asm["ptx"].count(word) for word in ("mma.sync", "wgmma.mma_async", "tcgen05.mma")
            )
            sys.stdout.write(json.dumps(found | {"products": products} | resources(compiled)) + "\n")
        return compiled


def resources(compiled: Any) -> dict[str, int]:
    """Return the registers and the bytes of stack, local and shared memory of a compiled kernel."""
    tool = Path(nvidia.__file__).parent / "bin" / "cuobjdump"
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(compiled.asm["cubin"])
        file.flush()
        text = subprocess.run(
            [tool, "-res-usage", file.name], capture_output=True, text=True, check=True
        ).stdout
    (line,) = (line for line in text.splitlines() if "REG:" in line)
    usage = dict(word.split(":", 1) for word in line.split() if ":" in word)
    sizes = {name.lower(): int(usage[name]) for name in ("REG", "STACK", "LOCAL")}
    return sizes | {"shared": compiled.metadata.shared} | instructions(compiled)


def instructions(compiled: Any) -> dict[str, int]:
    """Return how many instructions a warp has in all, and in each loop; there also those of float64."""
    tool = Path(nvidia.__file__).parent / "bin" / "nvdisasm"
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(compiled.asm["cubin"])
        file.flush()
        text = subprocess.run([tool, "-c", file.name], capture_output=True, text=True, check=True).stdout
    places: dict[str, int] = {}
    jumps: list[tuple[int, str]] = []
    doubles: list[int] = []
    count = 0
    for line in text.splitlines():
        if label := re.match(r"(\.L_x_\d+):", line):
            places[label[1]] = count
        elif found := re.match(r"\s+/\*[0-9a-f]{4,}\*/\s+(?:@!?U?P\w+ )?(\w+)", line):
            count += found[1] != "NOP"
            if found[1] in ("DADD", "DMUL", "DFMA", "DSETP"):
                doubles.append(count)
            if target := re.search(r"BRA.*`\((\.L_x_\d+)\)", line):
                jumps.append((count, target[1]))
    loops = [(places[label], at) for at, label in jumps if places.get(label, at) < at - 1]
    steps = [
        {"instructions": at - start, "doubles": sum(start < place <= at for place in doubles)}
        for start, at in loops
    ]
    return {"instructions": count, "steps": steps}


def main() -> None:
    """Compile attention, sums and traversal at the paper's sizes."""
    driver.set_active(NoGpu(int(sys.argv[1])))
    compilation = Compilation()
    JITFunction.run = lambda kernel, *arguments, **options: compilation(kernel, *arguments, **options)
    num_voxels = RESOLUTION[0] * RESOLUTION[1] * RESOLUTION[2]
    # The kernels do not run: the pairs need not be those of rays, and two views compile what twenty do.
    for views in (2, 7):
        pixel = torch.arange(views * FEATURE_SIZE[0] * FEATURE_SIZE[1])
        shapes = (views, *FEATURE_SIZE), (1, *RESOLUTION)
        pairs = PairList(pixel, pixel % num_voxels, len(pixel), num_voxels, *shapes).blocks()
        for item in sys.argv[2:]:
            name, dim, *both = item.split(":")
            dtype = getattr(torch, name)
            for to_voxels in (True, False) if both else (True,):
                compilation.case = f"{item} {'to voxels' if to_voxels else 'to pixels'}"
                sizes = (num_voxels, len(pixel)) if to_voxels else (len(pixel), num_voxels)
                query, key, value = (
                    torch.zeros(n, CHANNELS // int(dim), int(dim), dtype=dtype, requires_grad=True)
                    for n in (*sizes, sizes[1])
                )
                block_attention(query, key, value, pairs, to_voxels=to_voxels)[0].sum().backward()
            compilation.case = f"{item} sum"
            features = torch.zeros(len(pixel), CHANNELS, dtype=dtype, requires_grad=True)
            block_sum(features, pairs).sum().backward()
        compilation.case = "traversal"
        cameras = Cameras(torch.eye(3).expand(views, 3, 3), torch.eye(4).expand(views, 4, 4), (480, 640))
        trace_blocks(cameras, VoxelGrid(RESOLUTION, EXTENT, torch.zeros(3)), FEATURE_SIZE, 2, capacity=64)


if __name__ == "__main__":
    main()
