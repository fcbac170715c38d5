# SPDX-License-Identifier: Apache-2.0
"""Base classes of our metrics: a record for each scene, which counts once on however many ranks."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
from torch import Tensor
from torch import distributed as dist
from torch.nn import Module
from torchmetrics import Metric

from raytran.classes import PAPER_CLASSES, Classes
from raytran.errors import ConfigError, ShapeError
from raytran.structs import CadAlignments, ObjectSet, TensorStruct

Row = dict[str, str | int | float | bool | None]
"""One line of a table: column name to value, None where there is none."""


@dataclass(frozen=True)
class SceneRecord(TensorStruct):
    """What a metric found in one scene, float64 on the CPU.

    Attributes:
        scene_id: name of the scene.
        truths: ``(M, columns)``, one row for each true object, or for whatever else the metric counts.
        predictions: ``(P, columns)``, one row for each prediction, of the metrics over objects.
    """

    scene_id: str
    truths: Tensor
    predictions: Tensor = field(default_factory=lambda: torch.zeros(0, 0, dtype=torch.float64))


class SceneMetric(Metric):
    """Base of all our metrics: a record for each scene, in float64 in any run.

    A scene is known by its id and counts once: a distributed sampler that repeats scenes to make the ranks
    equal changes no result.
    """

    is_differentiable = False
    higher_is_better = True
    full_state_update = False

    truth_columns: int
    records: list[SceneRecord]

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_state("records", default=[], dist_reduce_fx=None)

    def add(self, record: SceneRecord) -> None:
        """Add the record of a scene."""
        self.records.append(record)

    def scenes(self) -> list[SceneRecord]:
        """Return the records in this process, or of all ranks while they are synchronised, one a scene."""
        first: dict[str, SceneRecord] = {}
        for record in self.records:
            first.setdefault(record.scene_id, record)
        return list(first.values())

    def truths(self) -> Tensor:
        """Return the rows ``truths`` of all scenes, ``(N, truth_columns)`` float64."""
        none = torch.zeros(0, self.truth_columns, dtype=torch.float64)
        return torch.cat([none, *(record.truths for record in self.scenes())])

    def synchronised_scenes(self) -> list[SceneRecord]:
        """Return the records of all ranks, one a scene; every rank must call it."""
        with self.sync_context():
            return self.scenes()

    def _sync_dist(self, dist_sync_fn: Callable[..., Any] | None = None, process_group: Any = None) -> None:
        """Gather the records of all ranks: torchmetrics itself gathers tensors only."""
        group = process_group or self.process_group
        of_ranks: list[list[SceneRecord]] = [[] for _ in range(dist.get_world_size(group))]
        dist.all_gather_object(of_ranks, self.records, group=group)
        self.records = [record for records in of_ranks for record in records]

    def _apply(self, fn: Callable[[Tensor], Tensor], exclude_state: Sequence[str] = ()) -> Module:
        """Leave the records as they are when the module changes device or type: bf16 would garble them."""
        super()._apply(fn, exclude_state=(*exclude_state, "records"))
        self._computed = None  # the base class has cast it
        return self


class ObjectMetric(SceneMetric):
    """Base of the metrics over objects: each scene is judged when it is given.

    Every scene given counts, with or without predictions, unless ``drops_missing``: then a scene whose
    predictions are None, for which there is no result at all, is left out.

    Args:
        classes: of the objects, or their settings, see ``Classes.of``; None: the paper's nine.
        **kwargs: see ``torchmetrics.Metric``.
    """

    prediction_columns: int
    judges_shapes = False  # else ``judge`` is given the objects without their shapes
    drops_missing: bool = False

    def __init__(self, *, classes: Classes | Mapping[str, Any] | None = None, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        # Boxes that are only compared may have classes that no network has.
        self.classes = classes if isinstance(classes, Classes) else Classes.of(classes)

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
            DataError: objects are of other classes than the metric.
        """
        if not len(predictions) == len(targets) == len(scene_ids):
            raise ShapeError(
                "expected predictions, targets and names of the same scenes, got "
                f"{len(predictions)}, {len(targets)} and {len(scene_ids)}"
            )
        for predicted, target, scene_id in zip(predictions, targets, scene_ids, strict=True):
            if predicted is None and self.drops_missing:
                continue
            objects = type(target).empty() if predicted is None else predicted
            for one in (objects, target):
                if isinstance(one, ObjectSet):
                    one.check_classes(self.classes, "the metric")
            tables = self.judge(self._in_float64(objects), self._in_float64(target))
            self.add(SceneRecord(scene_id, *tables))

    def predictions(self) -> Tensor:
        """Return the rows ``predictions`` of all scenes, ``(N, prediction_columns)`` float64."""
        none = torch.zeros(0, self.prediction_columns, dtype=torch.float64)
        return torch.cat([none, *(record.predictions for record in self.scenes())])

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


def check_protocol_classes(protocol: str, classes: Classes) -> None:
    """Raise if a protocol of a published script is asked for with other classes than those it is defined on.

    Raises:
        ConfigError: it is.
    """
    if classes.names != PAPER_CLASSES.names:
        raise ConfigError(
            f"protocol {protocol} is defined on Scan2CAD's nine classes, and these are {len(classes)} "
            "others: choose protocol=strict, or classes=paper"
        )


class ProtocolMetric(ObjectMetric):
    """Base of the metrics that follow a protocol: ``strict`` on boxes, published scripts on alignments.

    Args:
        protocol: its name.
        **kwargs: see ``ObjectMetric``.

    Raises:
        ConfigError: a published script's is asked for with other classes than its own.
    """

    def __init__(self, *, protocol: str, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.protocol = protocol
        if protocol != "strict":
            check_protocol_classes(protocol, self.classes)

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
