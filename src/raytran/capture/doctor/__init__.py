# SPDX-License-Identifier: Apache-2.0
"""The data doctor: checks a scan's cameras and annotation against its images, depth maps and CADs."""
