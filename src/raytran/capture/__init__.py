# SPDX-License-Identifier: Apache-2.0
"""Recordings of one's own: readers of what phones and reconstruction programs write, and the data doctor."""
