# SPDX-License-Identifier: Apache-2.0
"""From voxel and pixel features to raw predictions (RayTran §3.2); no loss in here."""
