# SPDX-License-Identifier: Apache-2.0
"""Mirrored, turned and missing CADs."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from raytran.capture.doctor.models import check_models
from raytran.data.scan2cad import read_annotations
from raytran.data.shapenet.models import mesh_path

from .conftest import SCAN


def annotation(root):
    return read_annotations(root / "scan2cad" / "full_annotations.json")[SCAN]


def spoil(root, turn):
    for model in set(annotation(root).model_id):
        path = mesh_path(root / "shapenet", *model.split("/"))
        lines = []
        for line in path.read_text().splitlines():
            if line.startswith("v "):
                vertex = turn @ np.array([float(word) for word in line.split()[1:4]])
                line = "v {:.8f} {:.8f} {:.8f}".format(*vertex)
            lines.append(line)
        path.write_text("\n".join(lines) + "\n")


def faults(root, shapenet="shapenet"):
    findings = check_models(annotation(root), None if shapenet is None else root / shapenet)
    return {finding.check: finding for finding in findings if finding.state == "fault"}


def test_true_models_are_not_flagged(room):
    assert faults(room) == {}


@pytest.mark.parametrize(
    ("turn", "cause", "word"),
    [
        (np.diag([1.0, 1.0, -1.0]), "mirrored CADs", "mirrored in z"),
        (np.diag([1.0, -1.0, 1.0]), "mirrored CADs", "mirrored in y"),
        (np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]), "turned CADs", "turned by 90° about y"),
        (np.diag([1.3, 1.3, 1.3]), "other CADs", "box differs"),
    ],
)
def test_spoiled_models_are_named(copy, turn, cause, word):
    spoil(copy, turn)
    found = faults(copy)
    assert list(found) == ["CAD meshes"]
    assert found["CAD meshes"].cause == cause
    assert word in found["CAD meshes"].text


def test_voxels_tell_when_the_annotation_was_mirrored_with_the_mesh(copy):
    spoil(copy, np.diag([1.0, 1.0, -1.0]))
    mirrored = annotation(copy)
    mirrored.box_center[:, 2] *= -1
    findings = check_models(mirrored, copy / "shapenet")
    assert findings[-1].cause == "mirrored CADs"
    assert "its voxels" in findings[-1].text
    assert findings[-1].confidence == "likely"


def test_negative_scale_is_named(room):
    mirrored = annotation(room)
    mirrored.scan_from_cad[1, :, 0] *= -1
    finding = check_models(mirrored, None)[0]
    assert finding.cause == "mirrored CADs (negative scale)"
    assert finding.text.startswith(f"1 of {len(mirrored.model_id)} alignments")


def test_missing_models_are_counted(copy):
    models = sorted(set(annotation(copy).model_id))
    shutil.rmtree(mesh_path(copy / "shapenet", *models[0].split("/")).parents[1])
    found = faults(copy)
    assert found["CAD files"].text.startswith(f"1 of {len(models)} CADs")
    assert found["CAD files"].cause == "missing CADs"


def test_without_models_meshes_are_unknown(room):
    findings = check_models(annotation(room), None)
    assert [finding.state for finding in findings] == ["ok", "unknown"]
