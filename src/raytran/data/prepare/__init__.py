# SPDX-License-Identifier: Apache-2.0
"""From ScanNet, ShapeNet and Scan2CAD as released to a folder to train from."""

from raytran.data.prepare.prepare import Prepared, prepare_scan2cad
from raytran.data.prepare.scan import PrepareSettings
from raytran.data.prepare.sources import Released

__all__ = ["PrepareSettings", "Prepared", "Released", "prepare_scan2cad"]
