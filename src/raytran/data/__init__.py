# SPDX-License-Identifier: Apache-2.0
"""The one data path: posed frames, annotations and CAD models on disk become batches; generated rooms."""
