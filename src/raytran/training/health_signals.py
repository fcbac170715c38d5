# SPDX-License-Identifier: Apache-2.0
"""Early signs of whether a DETR-like network learns: gradients by part, how the queries are used."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from raytran.losses.matcher import HungarianMatcher
from raytran.losses.objects import TrueObjects
from raytran.structs import PADDING, ObjectSet, RawObjects
from raytran.training.ranks import mean_over_ranks


def gradient_norms(model: nn.Module) -> dict[str, Tensor]:
    """Return the L2 norm of the gradients of each part: ``backbone``, ``objects`` and so on, scalars."""
    gradients: dict[str, list[Tensor]] = {}
    for name, parameter in model.named_parameters():
        if parameter.grad is not None:
            part = name.removeprefix("heads.").split(".")[0]
            gradients.setdefault(part, []).append(parameter.grad)
    return {part: nn.utils.get_total_norm(found) for part, found in gradients.items()}


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
    entropy = -(log_probability.exp() * log_probability).sum(dim=-1) / math.log(PADDING + 1)
    used = (log_probability.argmax(dim=-1) != PADDING).float()
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
        self._buffers = [buffer for buffers in found for buffer in buffers if buffer is not None]
        self._backup = [buffer.clone() for buffer in self._buffers]

    def save(self) -> None:
        """Back them up."""
        for saved, buffer in zip(self._backup, self._buffers, strict=True):
            saved.copy_(buffer)

    def restore(self) -> None:
        """Set them to the backup."""
        for saved, buffer in zip(self._backup, self._buffers, strict=True):
            buffer.copy_(saved)
