# SPDX-License-Identifier: Apache-2.0
"""Early signs of whether a DETR-like network learns: gradients by part, how the queries are used."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import groupby

import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from raytran.losses.matcher import HungarianMatcher
from raytran.losses.objects import TrueObjects
from raytran.structs import ObjectSet, RawObjects
from raytran.training.ranks import mean_over_ranks


def gradient_norms(model: nn.Module) -> dict[str, Tensor]:
    """Return the L2 norms of the gradients of each part, ``backbone``, ``objects`` …, and of ``all``.

    They are scalars. A part's parameters follow one another in the network.
    """
    gradients = {
        name: parameter.grad for name, parameter in model.named_parameters() if parameter.grad is not None
    }
    if not gradients:
        return {}
    norms = torch.stack(torch._foreach_norm(list(gradients.values())))
    parts = groupby(name.removeprefix("heads.").split(".")[0] for name in gradients)
    names, counts = zip(*((part, sum(1 for _ in members)) for part, members in parts), strict=True)
    found = {
        name: torch.linalg.vector_norm(some)
        for name, some in zip(names, norms.split(list(counts)), strict=True)
    }
    return found | {"all": torch.linalg.vector_norm(norms)}


@torch.no_grad()
def slot_signals(
    objects: RawObjects, targets: Sequence[ObjectSet], matcher: HungarianMatcher
) -> dict[str, Tensor]:
    """Return how the queries of all ranks are used, scalars in [0, 1]; all ranks must call this together.

    Returns:
        ``class_accuracy``: share of the queries matched with an object whose surest class is that object's;
        missing where no scene has objects. It should soon be better than that of guessing.
        ``class_entropy``: entropy of a query's class probabilities, mean over queries, 1 if all classes are
        equally likely. Near 0 from the start it means that queries are confident without a reason.
        ``slots_used``: share of the queries whose most likely class is an object's. It should approach the
        mean number of objects over that of queries; if it stays 0, the padding class has won.
    """
    objects = RawObjects(**{name: value.float() for name, value in vars(objects).items()})
    true = TrueObjects.of(*targets)
    match = matcher(RawObjects.stack([objects]), true, [len(of_scene) for of_scene in targets])
    surest = objects.class_logits.argmax(dim=-1).flatten()[match.query[0]]
    right = (surest == true.label[match.target[0]]).float().sum()
    matched = right.new_full((), match.query.shape[1])
    log_probability = objects.class_logits.log_softmax(dim=-1)
    outputs = log_probability.shape[-1]
    entropy = -(log_probability.exp() * log_probability).sum(dim=-1) / math.log(outputs)
    used = (log_probability.argmax(dim=-1) != outputs - 1).float()
    sums = torch.stack([right, matched, entropy.mean(), used.mean()])
    right, matched, entropy, used = mean_over_ranks(sums).unbind()
    found = {"class_entropy": entropy, "slots_used": used}
    return found | ({"class_accuracy": right / matched} if matched > 0 else {})


class RunningStatistics:
    """A backup of the running means and variances of a network's batch norms.

    The forward pass updates them before anything can tell that the step must be skipped: a value that is not
    finite would stay in them for good.

    Args:
        model: the network; batch norms in evaluation mode are left out.
    """

    def __init__(self, model: nn.Module) -> None:
        norms = [m for m in model.modules() if isinstance(m, _BatchNorm) and m.training]
        found = [(m.running_mean, m.running_var, m.num_batches_tracked) for m in norms]
        by_dtype: dict[torch.dtype, list[Tensor]] = {}
        for buffer in (one for buffers in found for one in buffers if one is not None):
            by_dtype.setdefault(buffer.dtype, []).append(buffer)
        self._groups = list(by_dtype.values())
        self._backup = [_joined(group) for group in self._groups]

    def save(self) -> None:
        """Back them up."""
        self._backup = [_joined(group) for group in self._groups]

    def restore(self, where: Tensor | None = None) -> None:
        """Set them to the backup.

        Args:
            where: a bool ``()``, whether to; so nobody waits to know it. None: do.
        """
        for group, saved in zip(self._groups, self._backup, strict=True):
            values = saved if where is None else torch.where(where, saved, _joined(group))
            parts = values.split([buffer.numel() for buffer in group])
            torch._foreach_copy_(
                group, [part.view_as(buffer) for part, buffer in zip(parts, group, strict=True)]
            )


def _joined(buffers: Sequence[Tensor]) -> Tensor:
    return torch.cat([buffer.flatten() for buffer in buffers])
