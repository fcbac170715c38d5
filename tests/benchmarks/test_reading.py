# SPDX-License-Identifier: Apache-2.0
"""How far one has to read to follow a step: the figures that the house is kept to."""

from __future__ import annotations

import reading


def test_a_training_step_goes_through_few_files():
    found = reading.training_step()
    assert {"model.py", "backbone/block.py", "ops/ray_attention.py", "losses/total.py"} <= set(found.files)
    assert (
        len(found.files) <= 22
    )  # one of them says where float64 is computed, for Apple's GPUs, which have none
    assert found.changes <= 110  # twenty of them enter a norm in the precision of its input


def test_a_prediction_goes_through_few_files():
    found = reading.prediction()
    assert {"model.py", "backbone/block.py", "heads/shape.py"} <= set(found.files)
    assert not any(name.startswith(("training/", "losses/")) for name in found.files)
    assert len(found.files) <= 21
    assert found.changes <= 140  # a dozen of them check the views, twenty enter a norm


def test_what_is_counted(tmp_path, monkeypatch):
    """Two files of which the first calls the second twice, and that calls back once."""
    (tmp_path / "first.py").write_text(
        "from second import g\n\ndef f():\n    return [g(0), g(1)]\n\ndef h():\n    return 0\n"
    )
    (tmp_path / "second.py").write_text("def g(n):\n    from first import h\n    return h() if n else 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(reading, "PACKAGE", tmp_path)
    import first

    found = reading.walk(first.f)
    assert list(found.files) == ["first.py", "second.py"]
    assert (found.changes, found.depth, len(found.functions)) == (3, 3, 3)
