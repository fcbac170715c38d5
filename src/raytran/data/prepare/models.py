# SPDX-License-Identifier: Apache-2.0
"""The CAD models that annotations use: copied, and their shapes made ahead of training."""

from __future__ import annotations

import shutil
from pathlib import Path

from raytran.data.cache import MaskCache
from raytran.data.prepare.annotation import NO_CAD
from raytran.data.prepare.scan import check_room
from raytran.data.shapenet.models import copy_model, has_model
from raytran.data.targets import shape_grids
from raytran.errors import DataError


def prepare_model(model_id: str, source: Path, output: Path) -> tuple[str, str | None]:
    """Copy a model unless it is there, and keep its shape among the targets.

    Args:
        model_id: ``catid/id``.
        source: folder of ShapeNet, of either version.
        output: the prepared folder.

    Returns:
        the model and, if it cannot be used, why.

    Raises:
        DataError: the disk of ``output`` is full or read-only.
    """
    catid, name = model_id.split("/")
    try:
        if not has_model(source, catid, name):
            return model_id, NO_CAD
        copy_model(source, catid, name, output / "shapenet")
        shape_grids((model_id,), shapenet_root=output / "shapenet", cache=MaskCache(folder=output / "cache"))
    except (DataError, OSError) as error:
        check_room(error, output)
        shutil.rmtree(output / "shapenet" / model_id, ignore_errors=True)
        return model_id, str(error)
    return model_id, None
