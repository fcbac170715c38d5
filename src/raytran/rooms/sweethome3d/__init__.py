# SPDX-License-Identifier: Apache-2.0
"""Converts freely licensed furniture to CAD models in the layout of ShapeNetCore v2."""

from raytran.rooms.sweethome3d.furniture import FurnitureReport, import_furniture

__all__ = ["FurnitureReport", "import_furniture"]
