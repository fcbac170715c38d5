# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import pytest
import torch

from raytran.errors import ConfigError
from raytran.geometry.rotation import rotation_from_yaw
from raytran.losses.objects import (
    Betas,
    Differences,
    Match,
    TrueObjects,
    object_losses,
    pose_errors,
    yaw_from_vector,
)
from raytran.structs import ObjectSet, RawObjects


def one_object(*, yaw: float = 0.0, symmetry: int = 1) -> ObjectSet:
    return ObjectSet(
        label=torch.tensor([3]),
        center=torch.tensor([[1.0, 2.0, 3.0]]),
        size=torch.tensor([[1.0, 2.0, 0.5]]),
        rotation=rotation_from_yaw(torch.tensor([yaw])),
        symmetry=torch.tensor([symmetry]),
        score=torch.ones(1),
    )


def errors(
    target: ObjectSet, *, shift: float = 0.0, ratio: float = 1.0, yaw: float = 0.0, betas: Betas | None = None
) -> dict[str, float]:
    differences = Differences.of(
        target.center + torch.tensor([shift, 0.0, 0.0]),
        (target.size * torch.tensor([ratio, 1.0, 1.0])).log(),
        3.0 * torch.tensor([[math.sin(yaw), math.cos(yaw)]]),
        TrueObjects.of(target),
    )
    found = pose_errors(differences, Betas() if betas is None else betas)
    return {name: float(value) for name, value in found.items()}


def test_values() -> None:
    """Smooth L1 with beta 0.1: |e| - 0.05 beyond it, 5 e² within."""
    assert errors(one_object(), shift=0.5)["center"] == pytest.approx(0.45)
    assert errors(one_object(), shift=0.05)["center"] == pytest.approx(0.0125, rel=1e-4)
    assert errors(one_object(), ratio=1.5)["size"] == pytest.approx(math.log(1.5), rel=1e-5)
    assert errors(one_object(), yaw=0.5)["yaw"] == pytest.approx(0.45)


@pytest.mark.parametrize("center", [0.0, 0.1, 0.5, 2.0])
@pytest.mark.parametrize("yaw", [0.0, 0.3, 1.0])
def test_betas_say_where_a_square_becomes_a_line(center: float, yaw: float) -> None:
    def smooth_l1(error: float, beta: float) -> float:
        return error**2 / (2 * beta) if error < beta else error - beta / 2

    betas = Betas(center, yaw)
    for error in (0.01, 0.2, 0.45, 1.5):
        found = errors(one_object(), shift=error, ratio=1.5, yaw=error, betas=betas)
        assert found["center"] == pytest.approx(smooth_l1(error, center), rel=1e-4, abs=1e-6)
        assert found["yaw"] == pytest.approx(smooth_l1(error, yaw), rel=1e-4, abs=1e-6)
        assert found["size"] == pytest.approx(math.log(1.5), rel=1e-5)


@pytest.mark.parametrize("betas", [Betas(center=-0.1), Betas(yaw=math.inf), Betas(center=math.nan)])
def test_betas_are_checked(betas: Betas) -> None:
    with pytest.raises(ConfigError, match=r"_beta=.*at least 0"):
        betas.checked()


def test_perfect_prediction_costs_nothing() -> None:
    found = errors(one_object(yaw=2.0), yaw=2.0)
    assert found == {name: pytest.approx(0.0, abs=1e-6) for name in ("center", "size", "yaw")}


@pytest.mark.parametrize(
    ("symmetry", "turn", "left"),
    [
        (1, math.pi / 2, math.pi / 2),
        (2, math.pi, 0.0),
        (2, 3.0, math.pi - 3.0),
        (4, math.pi / 2, 0.0),
        (0, 1.0, 0.0),
    ],
)
def test_yaw_error_is_the_least_over_symmetries(symmetry: int, turn: float, left: float) -> None:
    expected = left - 0.05 if left > 0.1 else 0.0
    assert errors(one_object(yaw=-1.0, symmetry=symmetry), yaw=turn - 1.0)["yaw"] == pytest.approx(
        expected, abs=1e-5
    )


def test_yaw_is_wrapped() -> None:
    assert errors(one_object(yaw=3.0), yaw=-3.0)["yaw"] == pytest.approx(2 * math.pi - 6.0 - 0.05, rel=1e-4)


@pytest.mark.parametrize("length", [1e-12, 1e-3, 1.0, 1e3])
def test_gradient_of_yaw_has_length_one_whatever_the_vectors(length: float) -> None:
    vector = (length * torch.tensor([[0.6, 0.8]])).requires_grad_()
    angle = yaw_from_vector(vector)
    angle.sum().backward()
    assert float(angle.detach()) == pytest.approx(math.atan2(0.6, 0.8), rel=1e-4)
    torch.testing.assert_close(vector.grad, torch.tensor([[0.8, -0.6]]), rtol=1e-3, atol=1e-4)


def test_zero_vector_has_finite_gradient() -> None:
    vector = torch.zeros(1, 2, requires_grad=True)
    yaw_from_vector(vector).sum().backward()
    assert bool(vector.grad.isfinite().all())


@pytest.mark.parametrize("no_object_weight", [1.0, 0.1])
def test_padding_is_weighted(make_objects, make_perfect, no_object_weight: float) -> None:
    """Uniform logits cost log 10 whatever the weights; a wrong padding slot counts by its weight."""
    objects, slots = make_objects(1), torch.tensor([0])
    raw = make_perfect(objects, slots, 3)
    match, true = Match(slots[None], torch.tensor([[0]])), TrueObjects.of(objects)

    def class_loss() -> float:
        layers = RawObjects.stack([raw])
        found = object_losses(
            layers,
            true,
            match,
            Differences.of_all(layers, true),
            num_objects=torch.tensor(1.0),
            class_weight=torch.tensor(1 + 2 * no_object_weight),
            no_object_weight=no_object_weight,
            betas=Betas(),
        )
        return float(found["class"].detach())

    raw.class_logits.data.zero_()
    assert class_loss() == pytest.approx(math.log(10))
    raw.class_logits.data[0, 0, objects.label] = 100.0
    raw.class_logits.data[0, 1, 9] = 100.0
    assert class_loss() == pytest.approx(math.log(10) * no_object_weight / (1 + 2 * no_object_weight))
