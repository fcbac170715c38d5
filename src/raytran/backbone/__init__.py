# SPDX-License-Identifier: Apache-2.0
"""From posed images to voxel and pixel features (RayTran §3.1)."""
