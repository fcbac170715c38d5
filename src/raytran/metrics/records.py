# SPDX-License-Identifier: Apache-2.0
"""Metrics that keep one record a scene, gathered exactly over the ranks of a distributed run."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import torch
from torch import Tensor
from torch.nn import Module
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat
from torchmetrics.utilities.distributed import gather_all_tensors

from raytran.errors import ShapeError
from raytran.structs import CadAlignments, ObjectSet

Row = dict[str, str | int | float | bool | None]
"""One line of a table: column name to value, None where there is none."""


@dataclass(frozen=True)
class SceneRecord:
    """The verdict on one scene.

    Attributes:
        scene_id: name of the scene.
        truths: ``(M, columns)`` float64, one row for each true object.
        predictions: ``(P, columns)`` float64, one row for each prediction.
    """

    scene_id: str
    truths: Tensor
    predictions: Tensor

    def encode(self) -> Tensor:
        """Return the record as one float64 vector: three lengths, the letters of the name, the tables."""
        name = [float(ord(letter)) for letter in self.scene_id]
        lengths = [float(len(name)), float(len(self.truths)), float(len(self.predictions))]
        head = self.truths.new_tensor(lengths + name, dtype=torch.float64)
        return torch.cat([head, self.truths.double().flatten(), self.predictions.double().flatten()])


def decode_records(stream: Tensor, truth_columns: int, prediction_columns: int) -> Iterator[SceneRecord]:
    """Take apart a vector of encoded records laid end to end."""
    position = 0
    while position < len(stream):
        n_letters, n_truths, n_predictions = (int(n) for n in stream[position : position + 3])
        parts = [n_letters, n_truths * truth_columns, n_predictions * prediction_columns]
        name, truths, predictions = stream[position + 3 : position + 3 + sum(parts)].split(parts)
        yield SceneRecord(
            "".join(chr(int(letter)) for letter in name),
            truths.reshape(n_truths, truth_columns),
            predictions.reshape(n_predictions, prediction_columns),
        )
        position += 3 + sum(parts)


def _gather_float64(value: Tensor, group: Any = None) -> list[Tensor]:
    """Gather vectors of any length from all ranks; a rank without scenes sends an empty float32 one."""
    return gather_all_tensors(value.double(), group)


class RecordMetric(Metric):
    """Base of all our metrics: what is found in a scene is kept as a record, in float64 in any run.

    A scene is known by its id and counts once: a distributed sampler that repeats scenes to make the ranks
    equal changes no result.
    """

    is_differentiable = False
    higher_is_better = True
    full_state_update = False

    truth_columns: int
    prediction_columns: int
    records: list[Tensor] | Tensor

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(dist_sync_fn=_gather_float64, **kwargs)
        self.add_state("records", default=[], dist_reduce_fx="cat")

    def keep(self, record: SceneRecord) -> None:
        """Add the record of a scene."""
        records = cast("list[Tensor]", self.records)  # a tensor only while synchronised
        records.append(record.encode().to(self._record_device()))

    def scenes(self) -> list[SceneRecord]:
        """Return the records in this process, or of all ranks while they are synchronised, one a scene."""
        if isinstance(self.records, list) and not self.records:
            return []
        stream = dim_zero_cat(self.records).cpu()
        found: dict[str, SceneRecord] = {}
        for record in decode_records(stream, self.truth_columns, self.prediction_columns):
            found.setdefault(record.scene_id, record)
        return list(found.values())

    def synchronised_scenes(self) -> list[SceneRecord]:
        """Return the records of all ranks, one a scene; every rank must call it."""
        with self.sync_context(dist_sync_fn=self.dist_sync_fn):
            return self.scenes()

    def _apply(self, fn: Callable[[Tensor], Tensor], exclude_state: Sequence[str] = ()) -> Module:
        """Follow the module to another device but not to another type: bf16 would garble the records."""
        super()._apply(fn, exclude_state=(*exclude_state, "records"))
        if isinstance(self.records, list):
            self.records = [record.to(self._record_device()) for record in self.records]
        self._computed = None  # the base class has cast it
        return self

    def _record_device(self) -> torch.device:
        return torch.device("cpu") if self.device.type == "mps" else self.device  # MPS has no float64


class SceneRecordMetric(RecordMetric):
    """Base of the metrics over objects: each scene is judged when it is given.

    Every scene given counts, with or without predictions, unless ``drops_missing``: then a scene whose
    predictions are None, for which there is no result at all, is left out.
    """

    judges_shapes = False  # else ``judge`` is given the objects without their shapes
    drops_missing: bool = False

    @abstractmethod
    def judge(self, predictions: Any, targets: Any) -> tuple[Tensor, Tensor]:
        """Return ``truths`` and ``predictions`` of a scene's record.

        Both inputs are ``ObjectSet``, or ``CadAlignments`` for the protocols of published scripts; in float64
        and on the CPU.
        """

    @abstractmethod
    def object_rows(self, record: SceneRecord) -> list[Row]:
        """Return one row for each true object of a scene."""

    @abstractmethod
    def scene_row(self, record: SceneRecord) -> Row:
        """Return the row of a scene."""

    def update(self, predictions: Sequence[Any], targets: Sequence[Any], scene_ids: Sequence[str]) -> None:
        """Judge scenes.

        Args:
            predictions: the predicted objects of each scene, ``ObjectSet`` or for the protocols of published
                scripts ``CadAlignments``; all of them count. None: there is no result for the scene.
            targets: the annotated objects of each scene, of the same type.
            scene_ids: the name of each scene.

        Raises:
            ShapeError: the three do not have the same length.
        """
        if not len(predictions) == len(targets) == len(scene_ids):
            raise ShapeError(
                "expected predictions, targets and names of the same scenes, got "
                f"{len(predictions)}, {len(targets)} and {len(scene_ids)}"
            )
        for predicted, target, scene_id in zip(predictions, targets, scene_ids, strict=True):
            if predicted is None and self.drops_missing:
                continue
            found = type(target).empty() if predicted is None else predicted
            tables = self.judge(*(self._in_float64(objects) for objects in (found, target)))
            self.keep(SceneRecord(scene_id, *tables))

    def rows(self, per: Literal["object", "scene"] = "object") -> list[Row]:
        """Return a table of all ranks' scenes; in a distributed run every rank must call it.

        Args:
            per: ``"object"`` for a row for each true object, ``"scene"`` for a row for each scene.
        """
        scenes = self.synchronised_scenes()
        if per == "scene":
            return [self.scene_row(record) for record in scenes]
        return [row for record in scenes for row in self.object_rows(record)]

    def _in_float64(self, objects: ObjectSet | CadAlignments) -> ObjectSet | CadAlignments:
        """Return the boxes of a set in float64 on the CPU."""
        if isinstance(objects, CadAlignments):
            return objects.to("cpu")
        boxes = (objects if self.judges_shapes else replace(objects, shape=None)).to("cpu")
        return replace(
            boxes,
            center=boxes.center.detach().double(),
            size=boxes.size.detach().double(),
            rotation=boxes.rotation.detach().double(),
            score=boxes.score.detach().double(),
        )


class ProtocolMetric(SceneRecordMetric):
    """Base of the metrics that follow a protocol: ``strict`` on boxes, published scripts on alignments."""

    protocol: str

    def judge(
        self, predictions: ObjectSet | CadAlignments, targets: ObjectSet | CadAlignments
    ) -> tuple[Tensor, Tensor]:
        """Match one scene by the protocol; see the base class.

        Raises:
            ShapeError: the protocol compares objects of the other type.
        """
        strict = self.protocol == "strict"
        if strict and isinstance(predictions, ObjectSet) and isinstance(targets, ObjectSet):
            return self.judge_objects(predictions, targets)
        if not strict and isinstance(predictions, CadAlignments) and isinstance(targets, CadAlignments):
            return self.judge_cads(predictions, targets)
        kind = "ObjectSet" if strict else "CadAlignments"
        raise ShapeError(f"protocol {self.protocol} compares two {kind} for each scene")

    @abstractmethod
    def judge_objects(self, predictions: ObjectSet, targets: ObjectSet) -> tuple[Tensor, Tensor]:
        """Match one scene by protocol ``strict``."""

    @abstractmethod
    def judge_cads(self, predictions: CadAlignments, targets: CadAlignments) -> tuple[Tensor, Tensor]:
        """Match one scene by the protocol of a published script."""
