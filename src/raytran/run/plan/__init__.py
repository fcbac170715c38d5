# SPDX-License-Identifier: Apache-2.0
"""The command plan: memory and time before a run."""
