# SPDX-License-Identifier: Apache-2.0
"""Scans in ScanNet's layout."""
