# SPDX-License-Identifier: Apache-2.0
"""From a film without poses to a scan: sharp frames, cameras by pycolmap, up and metres."""
