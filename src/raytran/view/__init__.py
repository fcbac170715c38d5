# SPDX-License-Identifier: Apache-2.0
"""Pictures of scenes and predictions, and the page that shows them."""
