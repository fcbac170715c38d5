# SPDX-License-Identifier: Apache-2.0
"""What goes beyond the paper: chosen in the config by ``_target_``; nothing of the method imports it."""
