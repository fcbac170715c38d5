# SPDX-License-Identifier: Apache-2.0
"""Parametric furniture: one file per family, built from the parts of ``parts.py``, in metres."""
