# SPDX-License-Identifier: Apache-2.0
"""Is a scan right? Each reading of its files is held against what the images, depths and CADs say."""
