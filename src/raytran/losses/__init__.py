# SPDX-License-Identifier: Apache-2.0
"""From raw predictions and targets to scalars to minimise (RayTran §3.2)."""
