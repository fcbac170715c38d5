# SPDX-License-Identifier: Apache-2.0
"""The operators of ray-traced attention as Triton kernels, for GPUs."""
