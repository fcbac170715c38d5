# SPDX-License-Identifier: Apache-2.0
"""Videos of one's own: readers that turn what phones and reconstruction programs write into a scan."""
