# SPDX-License-Identifier: Apache-2.0
"""RayTran: every object of a room, with class, 9-DoF pose and mesh, from a posed RGB video."""

__version__ = "0.1.0"
