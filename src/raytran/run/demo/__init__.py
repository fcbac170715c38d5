# SPDX-License-Identifier: Apache-2.0
"""The demo: the whole path on generated rooms."""
