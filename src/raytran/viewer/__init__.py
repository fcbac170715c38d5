# SPDX-License-Identifier: Apache-2.0
"""The page in a browser that shows predicted scenes, and the server behind it."""
