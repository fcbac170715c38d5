# SPDX-License-Identifier: Apache-2.0
"""The base of the dataclasses that cross folders: tensors that move between devices as one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

_Parcel = TypeVar("_Parcel", bound="Parcel")


@dataclass(frozen=True)
class Parcel:
    """A frozen dataclass of tensors (or of parcels, or tuples of them) that moves between devices as one."""

    def to(self: _Parcel, device: torch.device | str, *, non_blocking: bool = False) -> _Parcel:
        """Return a copy with every tensor inside on ``device``."""
        return self._map(lambda item: item.to(device, non_blocking=non_blocking))

    def pin_memory(self: _Parcel) -> _Parcel:
        """Return a copy with every tensor inside in page-locked memory (called by ``DataLoader``)."""
        return self._map(lambda item: item.pin_memory())

    def _map(self: _Parcel, change: Callable[[Any], Any]) -> _Parcel:
        def visit(value: Any) -> Any:
            if isinstance(value, Tensor | Parcel):
                return change(value)
            return tuple(visit(item) for item in value) if isinstance(value, tuple) else value

        return replace(self, **{field.name: visit(getattr(self, field.name)) for field in fields(self)})

    def _select(self: _Parcel, count: int, index: Tensor) -> _Parcel:
        """Return rows of a parcel whose fields all have ``count`` rows, or none."""
        chosen = torch.arange(count, device=index.device)[index].tolist()

        def pick(value: Any) -> Any:
            if isinstance(value, tuple):
                return tuple(value[i] for i in chosen) if value else ()
            return None if value is None else value[index]

        return replace(self, **{field.name: pick(getattr(self, field.name)) for field in fields(self)})
