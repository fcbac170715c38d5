# SPDX-License-Identifier: Apache-2.0
"""The fused kernels go through Triton's compiler for GPUs that need not be there, with the Triton at hand.

CI does the same with the Triton of every supported torch.
"""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

import raytran.ops
from raytran.ops.pairs import MOST_CHANNELS

pytest.importorskip("triton", reason="Triton is not installed: there is no compiler to ask")

SCRIPT = Path(__file__).with_name("compile_kernels.py")
CAPABILITIES = (80, 89, 90, 100)  # A100, RTX 4090 and L40S, H100 and H200, B200
PAPER = ("bfloat16:32:both", "float16:32", "float32:32")
FEW = ("bfloat16:32:both", "float32:32")
ATTENTION = ("attend_forward", "attend_backward_targets", "attend_backward_sources")
MOST_INSTRUCTIONS = {"attend_forward": 1111, "attend_backward_targets": 1080, "attend_backward_sources": 1346}
"""Instructions of all warps in an inner step, in 16 bits: 60 % of what four warps have, who do much twice."""
MOST_SHARED = 99 * 1024  # bytes a program may have on an RTX 4090, the least of these GPUs
MOST_STACK = 64  # bytes a thread; Triton 3.4 and 3.6 take up to 40 in float32 and for heads of 128


def compiled(capability: int, cases: tuple[str, ...]) -> list[dict]:
    command = [sys.executable, "-W", "ignore", str(SCRIPT), str(capability), *cases]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-3000:]
    return [json.loads(line) for line in result.stdout.splitlines()]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("capability", "cases"),
    [(90, FEW), *(pytest.param(each, PAPER, marks=pytest.mark.nightly) for each in CAPABILITIES)],
)
def test_paper_sizes_compile_once_for_any_number_of_views_and_spill_nothing(capability, cases):
    found = compiled(capability, cases)
    counts = Counter(kernel["kernel"] for kernel in found)
    for name in (*ATTENTION, "merge_forward"):
        assert counts[name] == len(cases) + 1  # a dtype and a direction each
    assert {counts[name] for name in ("touch_blocks", "list_blocks", "mask_blocks")} == {1}
    for kernel in found:
        assert kernel["local"] == 0, kernel
        assert kernel["stack"] <= (MOST_STACK if "float32" in kernel["case"] else 16), kernel
        assert kernel["shared"] <= MOST_SHARED, kernel
        if kernel["kernel"] in ATTENTION and "float32" not in kernel["case"]:
            assert kernel["products"] > 0, kernel  # on tensor cores
            assert kernel["warps"] == 2, kernel  # more would do everything twice
            longest = max(step["instructions"] for step in kernel["steps"])
            assert longest * kernel["warps"] <= MOST_INSTRUCTIONS[kernel["kernel"]], kernel
        if kernel["kernel"] in ("touch_blocks", "mask_blocks"):
            first, again = kernel["steps"]  # in float32, and where that leaves a doubt in float64
            assert first["doubles"] == 0 < again["doubles"], kernel


@pytest.mark.slow
@pytest.mark.nightly
def test_the_largest_heads_that_are_not_refused_spill_nothing_that_matters():
    cases = [f"{str(dtype).removeprefix('torch.')}:{channels}" for dtype, channels in MOST_CHANNELS.items()]
    for kernel in compiled(80, (*cases, "bfloat16:64")):
        assert kernel["local"] == 0, kernel
        assert kernel["stack"] <= MOST_STACK, kernel
        assert kernel["shared"] <= MOST_SHARED, kernel


def jit_functions() -> dict[str, ast.FunctionDef]:
    """Return the functions of ``raytran.ops`` that Triton compiles, by name."""
    found = {}
    for path in Path(raytran.ops.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and "triton.jit" in map(ast.unparse, decorators(node)):
                found[node.name] = node
    return found


def decorators(function: ast.FunctionDef) -> list[ast.expr]:
    return [node.func if isinstance(node, ast.Call) else node for node in function.decorator_list]


def test_no_constant_out_of_a_tuple_is_handed_on():
    """Triton before 3.8 loses it on the way, and nothing compiles with the Triton of torch 2.8 to 2.13."""
    functions = jit_functions()
    assert set(ATTENTION) < set(functions)
    for name, function in functions.items():
        constants = {
            a.arg for a in function.args.args if a.annotation and "constexpr" in ast.unparse(a.annotation)
        }
        for call in (node for node in ast.walk(function) if isinstance(node, ast.Call)):
            if ast.unparse(call.func) in functions:
                handed = [a.value for a in call.args if isinstance(a, ast.Subscript)]
                lost = {
                    n.id for value in handed for n in ast.walk(value) if isinstance(n, ast.Name)
                } & constants
                assert not lost, f"{name} hands an element of {lost} to {ast.unparse(call.func)}"
