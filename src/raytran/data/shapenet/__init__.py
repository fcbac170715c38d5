# SPDX-License-Identifier: Apache-2.0
"""CAD models in ShapeNet's layout."""
