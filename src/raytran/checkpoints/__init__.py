# SPDX-License-Identifier: Apache-2.0
"""Checkpoints: what is in one, how it is read and written, and the runs that leave them."""
