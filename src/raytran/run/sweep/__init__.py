# SPDX-License-Identifier: Apache-2.0
"""Sweeps: several runs of one command."""
