# SPDX-License-Identifier: Apache-2.0
"""Freely licensed furniture turned into CAD models in the layout of ShapeNetCore v2."""

from raytran.data.cads.furniture import FurnitureReport, import_furniture

__all__ = ["FurnitureReport", "import_furniture"]
