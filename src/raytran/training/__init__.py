# SPDX-License-Identifier: Apache-2.0
"""Fitting the model: the only folder that knows Lightning."""
