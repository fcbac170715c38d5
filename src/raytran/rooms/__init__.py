# SPDX-License-Identifier: Apache-2.0
"""Furnished rooms by the number, written in the raw layout of ScanNet, ShapeNet and Scan2CAD."""
