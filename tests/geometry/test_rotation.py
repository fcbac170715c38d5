# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from raytran.errors import ShapeError
from raytran.geometry.rotation import (
    geodesic_angle,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotation_from_yaw,
    symmetric_yaw_error,
    upright_basis,
    wrap_angle,
    yaw_from_rotation,
)
from raytran.structs import SYMMETRY_INFINITE


def _random(count: int) -> Rotation:
    return Rotation.random(count, random_state=0)


def _tensor(rotation: Rotation) -> torch.Tensor:
    return torch.tensor(rotation.as_matrix())


def test_upright_object_of_yaw_zero():
    # Object up (+y) is up in the world (+z); its front (-z) looks to +y; its x stays x.
    basis = upright_basis()
    assert (basis @ torch.tensor([0.0, 1.0, 0.0])).tolist() == [0.0, 0.0, 1.0]
    assert (basis @ torch.tensor([0.0, 0.0, -1.0])).tolist() == [0.0, 1.0, 0.0]
    assert torch.equal(rotation_from_yaw(torch.tensor(0.0)), basis)


def test_yaw_turns_counter_clockwise_seen_from_above():
    yaw = torch.linspace(-3.1, 3.1, 9).double()
    expected = _tensor(Rotation.from_euler("z", yaw[:, None].numpy())) @ upright_basis(dtype=torch.float64)
    torch.testing.assert_close(rotation_from_yaw(yaw), expected)
    torch.testing.assert_close(
        rotation_from_yaw(yaw)[:, :, 0], torch.stack([yaw.cos(), yaw.sin(), 0 * yaw], -1)
    )
    torch.testing.assert_close(yaw_from_rotation(rotation_from_yaw(yaw)), yaw)


def test_yaw_of_a_tilted_object_is_that_of_the_closest_upright_one():
    rotations = _tensor(_random(20))
    candidates = rotation_from_yaw(torch.linspace(-math.pi, math.pi, 20001).double())
    distance = (rotations[:, None] - candidates).square().sum(dim=(-2, -1))
    best = torch.linspace(-math.pi, math.pi, 20001).double()[distance.argmin(dim=1)]
    assert wrap_angle(yaw_from_rotation(rotations) - best).abs().max() < 2e-4


def test_wrap_angle():
    angles = torch.tensor([0.0, math.pi, -math.pi, 3 * math.pi / 2, -7.0, 100.0], dtype=torch.float64)
    wrapped = wrap_angle(angles)
    assert (wrapped >= -math.pi).all()
    assert (wrapped < math.pi).all()
    turns = (angles - wrapped) / (2 * math.pi)
    torch.testing.assert_close(turns, turns.round())


@pytest.mark.parametrize(
    ("symmetry", "predicted_degrees", "target_degrees", "error_degrees"),
    [
        (1, 170, -170, -20),
        (1, 90, 0, 90),
        (2, 170, 0, -10),
        (2, 80, 0, 80),
        (4, 80, 0, -10),
        (4, -130, 0, -40),
        (SYMMETRY_INFINITE, 123, 0, 0),
    ],
)
def test_symmetric_yaw_error(symmetry, predicted_degrees, target_degrees, error_degrees):
    error = symmetric_yaw_error(
        torch.tensor(math.radians(predicted_degrees)),
        torch.tensor(math.radians(target_degrees)),
        torch.tensor(symmetry),
    )
    assert math.degrees(error) == pytest.approx(error_degrees, abs=1e-4)


def test_symmetric_yaw_error_carries_the_gradient_of_the_prediction():
    predicted = torch.tensor([3.0, 3.0, 3.0], requires_grad=True)
    symmetric_yaw_error(predicted, torch.zeros(3), torch.tensor([1, 2, SYMMETRY_INFINITE])).sum().backward()
    assert predicted.grad.tolist() == [1.0, 1.0, 0.0]


def test_quaternion_of_the_closest_rotation():
    rotations = Rotation.random(50, random_state=4)
    wxyz = torch.from_numpy(rotations.as_quat()[:, [3, 0, 1, 2]].copy())
    exact = quaternion_from_matrix(_tensor(rotations))
    torch.testing.assert_close((exact * wxyz).sum(dim=-1).abs(), torch.ones(50).double())
    shear = (
        torch.eye(3).double() + 0.2 * torch.rand(3, 3, generator=torch.Generator().manual_seed(0)).double()
    )
    u, _, vt = torch.linalg.svd(_tensor(rotations) @ shear)
    closest = matrix_from_quaternion(quaternion_from_matrix(_tensor(rotations) @ shear))
    torch.testing.assert_close(closest, u @ vt)
    with_nan = torch.stack([torch.eye(3), torch.full((3, 3), torch.nan)])
    assert quaternion_from_matrix(with_nan).isnan().all(dim=-1).tolist() == [False, True]
    assert quaternion_from_matrix(torch.zeros(0, 3, 3)).shape == (0, 4)


def test_quaternions_of_any_length_and_sign():
    rotations = _random(20)
    wxyz = torch.tensor(rotations.as_quat())[:, [3, 0, 1, 2]]
    torch.testing.assert_close(matrix_from_quaternion(wxyz), _tensor(rotations))
    torch.testing.assert_close(matrix_from_quaternion(-3.7 * wxyz), _tensor(rotations))
    with pytest.raises(ShapeError):
        matrix_from_quaternion(torch.zeros(3))


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.3, 2.0, math.pi - 1e-3, math.pi])
def test_geodesic_angle(angle):
    axis = torch.nn.functional.normalize(torch.tensor([1.0, -2.0, 0.5]).double(), dim=0)
    start = _tensor(_random(1))[0]
    turned = start @ _tensor(Rotation.from_rotvec(angle * axis.numpy()))
    assert float(geodesic_angle(start, turned)) == pytest.approx(angle, abs=1e-7)
