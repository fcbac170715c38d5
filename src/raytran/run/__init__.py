# SPDX-License-Identifier: Apache-2.0
"""What the commands do: config in, files out. Only this folder and the entry points read a config."""
