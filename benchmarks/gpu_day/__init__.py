# SPDX-License-Identifier: Apache-2.0
"""The parts of ``benchmarks/gpu_day.py``, a file for each."""
