# SPDX-License-Identifier: Apache-2.0
"""Part 3: how often the host waits for the device in a training step, and memory errors of the kernels."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

from fit import run_steps, step_config

from gpu_day.context import Context
from raytran.run.plan.camera_paths import walk

PRESET = "raytran"

MOST_WAITS, MOST_LAUNCHES = 1, 1300
"""Of a training step; the second of stage 2."""


def training_steps(context: Context) -> None:
    """Count waits and launches in a step of each stage, as the Trainer takes it."""
    sizes = context.sizes
    for stage in ("stage1", "stage2", "stage3"):
        name, bar = f"waits in a step of {stage}", f"≤ {MOST_WAITS}"
        with context.checks.attempt(name, bar):
            cfg = step_config(PRESET, stage, context.device, sizes.settings)
            height, width = cfg.views.image_size
            cameras = walk(sizes.views).scaled_to((height, width))
            steps = run_steps(cfg, cameras, context.device, timed=0, warm_up=sizes.warm_up)
            places = [f"{times:3d} × {place}" for place, times in Counter(steps.waits).most_common()]
            count = len(steps.waits)
            if count:
                passed = count <= MOST_WAITS
                context.checks.add(name, bar=bar, measured=str(count), passed=passed, notes=places)
            else:
                # For the matching's costs, or for the number of pairs.
                context.checks.add(name, bar=bar, why="none was seen, not even the one that must be there")
            launches, most = steps.launches, f"≤ {MOST_LAUNCHES:,}" if stage == "stage2" else ""
            name = f"kernels launched in a step of {stage}"
            if launches is None:
                context.checks.add(name, bar=most, why="nothing counts them here")
            else:
                passed = launches <= MOST_LAUNCHES if most else None
                context.checks.add(name, bar=most, measured=f"{launches:,}", passed=passed)


def memory_errors(context: Context) -> None:
    """Run the kernels at small sizes under compute-sanitizer, if it is installed."""
    name, bar = "compute-sanitizer memcheck on the kernels", "no error"
    tool = shutil.which("compute-sanitizer")
    if tool is None or context.device.why_unmeasured:
        context.checks.add(
            name, bar=bar, why="there is no GPU" if context.device.why_unmeasured else "it is not on PATH"
        )
        return
    with context.checks.attempt(name, bar):
        command = [tool, "--tool", "memcheck", "--error-exitcode", "86", "--print-limit", "20"]
        command += [sys.executable, str(Path(__file__).with_name("sanitized.py"))]
        # Every tensor an allocation of its own: what runs over its end is seen.
        environment = os.environ | {"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
        lines = (done.stdout + done.stderr).splitlines()
        told = [line for line in lines if "ERROR SUMMARY" in line]
        measured = told[-1].strip("= ") if told else f"exit code {done.returncode}"
        passed = done.returncode == 0
        context.checks.add(
            name, bar=bar, measured=measured, passed=passed, notes=[] if passed else lines[-40:]
        )
