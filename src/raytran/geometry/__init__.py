# SPDX-License-Identifier: Apache-2.0
"""Cameras, the voxel grid, rotations and boxes: pure functions of tensors."""
