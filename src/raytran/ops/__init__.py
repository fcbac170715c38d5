# SPDX-License-Identifier: Apache-2.0
"""Rays through voxels, and what runs along them: traversal, ray-traced attention, feature splatting."""
