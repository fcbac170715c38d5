# SPDX-License-Identifier: Apache-2.0
"""Scans whose objects are annotated by boxes: captures of any format with a list, and ARKitScenes."""
