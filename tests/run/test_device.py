# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch

from raytran.errors import ConfigError
from raytran.run.device import choose_device, cudnn_warning, set_matmul_precision

CPU, GPU = torch.device("cpu"), torch.device("cuda")


@pytest.fixture
def as_before():
    before = torch.get_float32_matmul_precision(), torch.backends.cudnn.allow_tf32
    yield
    torch.set_float32_matmul_precision(before[0])
    torch.backends.cudnn.allow_tf32 = before[1]


def test_a_device_that_is_not_there_is_one_sentence():
    assert choose_device("cpu") == CPU
    with pytest.raises(ConfigError, match=r"cannot use device=cuda:99 .*: choose auto or cpu"):
        choose_device("cuda:99")


@pytest.mark.parametrize(
    ("cuda", "apple", "chosen"),
    [(True, True, "cuda"), (True, False, "cuda"), (False, True, "mps"), (False, False, "cpu")],
)
def test_auto_is_the_best_there_is(cuda, apple, chosen, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: cuda)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: apple)
    assert choose_device("auto") == torch.device(chosen)


@pytest.mark.parametrize(
    ("name", "device", "products", "convolutions"),
    [
        ("auto", GPU, "high", True),
        ("highest", GPU, "highest", False),
        ("medium", GPU, "medium", True),
        ("auto", CPU, "highest", None),  # what torch does by itself
        ("high", CPU, "high", None),
    ],
)
def test_products_and_convolutions_are_as_exact_as_each_other(
    name, device, products, convolutions, as_before
):
    before = torch.backends.cudnn.allow_tf32
    set_matmul_precision(name, device)
    assert torch.get_float32_matmul_precision() == products
    assert torch.backends.cudnn.allow_tf32 == (before if convolutions is None else convolutions)


@pytest.mark.parametrize(
    ("version", "device", "precision", "name"),
    [
        (91002, GPU, "bf16-mixed", "9.10"),
        (90800, GPU, "16-mixed", "9.8"),
        (91400, GPU, "bf16-mixed", "9.14"),
        (91002, GPU, "32-true", None),
        (91501, GPU, "bf16-mixed", None),
        (90701, GPU, "bf16-mixed", None),
        (91002, CPU, "bf16-mixed", None),
        (None, GPU, "bf16-mixed", None),
    ],
)
def test_a_cudnn_without_16_bit_convolutions_is_told(version, device, precision, name, monkeypatch):
    monkeypatch.setattr(torch.backends.cudnn, "version", lambda: version)
    told = cudnn_warning(device, precision)
    assert told is None if name is None else told.startswith(f"cuDNN {name} has faulty 3D convolutions")
