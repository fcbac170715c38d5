# SPDX-License-Identifier: Apache-2.0
"""Pure functions behind the metrics, one scene at a time."""
