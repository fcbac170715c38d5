# SPDX-License-Identifier: Apache-2.0
"""An object gets the CAD model it is most like, and the pose that puts the model where the object is."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from raytran.classes import PAPER_CLASSES
from raytran.data.scan2cad import read_annotations, scene_alignments, scene_objects
from raytran.data.shapenet.models import model_names, read_mesh
from raytran.data.shapenet.voxelize import voxelize_solid
from raytran.errors import DataError
from raytran.export import nearest_cad as module
from raytran.export.nearest_cad import nearest_cads
from raytran.geometry.rotation import matrix_from_quaternion, rotation_from_yaw
from raytran.structs import ObjectSet

CHAIR, TABLE, LAMP = "03001627", "04379243", "03636649"
SIDE = 21

# Corners (low, high) of boxes, metres, +Y up, front -Z.
SEAT, BACK = [[0, 0.4, 0], [0.5, 0.5, 0.5]], [[0, 0.5, 0.4], [0.5, 1, 0.5]]
LEGS = [[[x, 0, z], [x + 0.05, 0.4, z + 0.05]] for x in (0, 0.45) for z in (0, 0.45)]
FOOT = [[0.2, 0, 0.2], [0.3, 0.4, 0.3]]
MODELS = {
    (CHAIR, "four_legs"): [SEAT, BACK, *LEGS],
    (CHAIR, "one_foot"): [SEAT, BACK, FOOT],
    (CHAIR, "armchair"): [[[0, 0, 0], [0.5, 0.5, 0.5]], BACK],
    (CHAIR, "bench"): [[[4 * low, *rest] for low, *rest in box] for box in (SEAT, BACK, *LEGS)],
    (TABLE, "cube"): [[[0, 0, 0], [0.5, 0.5, 0.5]]],
    (LAMP, "pole"): [[[0.2, 0, 0.2], [0.25, 1.5, 0.25]], [[0, 1.5, 0], [0.5, 1.8, 0.5]]],
}


def write_cad(root: Path, catid: str, name: str, boxes: list) -> None:
    """Write a model as ShapeNetCore v2 does: diagonal 1, the mean vertex at the origin."""
    mesh = trimesh.util.concatenate([trimesh.creation.box(bounds=bounds) for bounds in boxes])
    low, high, centroid = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0), mesh.vertices.mean(axis=0)
    vertices = (mesh.vertices - centroid) / np.linalg.norm(high - low)
    folder = root / catid / name / "models"
    folder.mkdir(parents=True)
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    (folder / "model_normalized.obj").write_text("\n".join(lines) + "\n")
    facts = {"numVertices": len(vertices), "min": low.tolist(), "max": high.tolist()}
    (folder / "model_normalized.json").write_text(json.dumps(facts | {"centroid": centroid.tolist()}))


@pytest.fixture(scope="module")
def library(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("cads")
    for (catid, name), boxes in MODELS.items():
        write_cad(root, catid, name, boxes)
    return root


def objects_like(library: Path, *wanted: tuple[str, str], noise: float = 0.0) -> ObjectSet:
    """What a network that errs a little says of models of the library that stand in a room."""
    meshes = [read_mesh(library, *names) for names in wanted]
    rng = np.random.default_rng(0)
    shapes = np.stack([voxelize_solid(mesh.vertices, mesh.faces, size=SIDE) for mesh in meshes])
    wrong = rng.random(shapes.shape) < noise
    stretch = np.exp(noise * rng.standard_normal((len(wanted), 3)))
    sizes = np.stack([np.ptp(mesh.vertices, axis=0) for mesh in meshes]) * stretch
    labels = [{CHAIR: "chair", TABLE: "table"}.get(catid, "other") for catid, _ in wanted]
    return ObjectSet(
        label=torch.tensor([PAPER_CLASSES.index(label) for label in labels]),
        center=torch.from_numpy(rng.uniform(0, 4, (len(wanted), 3))).float(),
        size=torch.from_numpy(sizes).float(),
        rotation=rotation_from_yaw(torch.arange(len(wanted)).float()),
        symmetry=torch.ones(len(wanted), dtype=torch.int64),
        score=torch.linspace(0.9, 0.5, len(wanted)),
        shape=torch.from_numpy(shapes ^ wrong).float(),
    )


def find(objects: ObjectSet, root: Path) -> module.NearestCads:
    return nearest_cads(objects, root, processes=1, progress=False)


def test_every_model_is_found_again(library):
    wanted = [("/".join(names)) for names in MODELS]
    found = find(objects_like(library, *MODELS, noise=0.1), library)
    assert found.objects.model_id == tuple(wanted)


def test_the_pose_fills_the_objects_box(library):
    objects = objects_like(library, *MODELS, noise=0.1)
    found = find(objects, library)
    alignments = found.alignments()
    assert (alignments.catid[0], alignments.id_cad[0]) == (CHAIR, "four_legs")
    for m, mesh in enumerate(found.meshes()):
        # A point p of the CAD model goes to t + R (s · p), the benchmark's convention.
        points = torch.from_numpy(np.array(read_mesh(library, *alignments.model_id[m].split("/")).vertices))
        rotation = matrix_from_quaternion(alignments.quaternion[m])
        placed = alignments.translation[m] + (alignments.scale[m] * points) @ rotation.T
        in_box = (placed - objects.center[m]) @ objects.rotation[m].double()
        torch.testing.assert_close(in_box.amin(dim=0), -objects.size[m].double() / 2, rtol=0, atol=1e-6)
        torch.testing.assert_close(in_box.amax(dim=0), objects.size[m].double() / 2, rtol=0, atol=1e-6)
        assert np.allclose(mesh.vertices, placed, atol=1e-6)


def test_proportions_decide_between_like_shapes(library):
    # Over its own box, the bench is a chair.
    chair = objects_like(library, (CHAIR, "four_legs"))
    wide = replace(chair, size=chair.size * torch.tensor([3.0, 1.0, 1.0]))
    assert find(chair, library).objects.model_id == (f"{CHAIR}/four_legs",)
    assert find(wide, library).objects.model_id == (f"{CHAIR}/bench",)
    # Without a shape only they can.
    assert find(replace(wide, shape=None), library).objects.model_id == (f"{CHAIR}/bench",)
    empty = torch.zeros_like(wide.shape)
    assert find(replace(wide, shape=empty), library).objects.model_id == (f"{CHAIR}/bench",)


def test_the_best_of_all_is_found(library):
    """Against every model, by the definition: IoU of the cells times IoU of the boxes at one diagonal."""
    chairs = [(CHAIR, name) for catid, name in MODELS if catid == CHAIR]
    objects = objects_like(library, *chairs, *chairs, noise=0.35)
    meshes = [read_mesh(library, *names) for names in chairs]
    fits = np.zeros((len(objects), len(chairs)))
    for k, mesh in enumerate(meshes):
        cells, extents = voxelize_solid(mesh.vertices, mesh.faces, size=SIDE), np.ptp(mesh.vertices, axis=0)
        for m, (size, shape) in enumerate(
            zip(objects.size.numpy(), objects.shape.numpy() > 0.5, strict=True)
        ):
            one, other = extents / np.linalg.norm(extents), size / np.linalg.norm(size)
            common = np.minimum(one, other).prod()
            boxes = common / (one.prod() + other.prod() - common)
            fits[m, k] = boxes * (cells & shape).sum() / (cells | shape).sum()
    expected = tuple("/".join(chairs[k]) for k in fits.argmax(axis=1))
    assert find(objects, library).objects.model_id == expected
    # Noise this strong makes some of them fit another model better.
    assert expected != tuple("/".join(names) for names in (*chairs, *chairs))


def test_models_that_cannot_win_are_not_read(library, monkeypatch):
    read: list[str] = []
    inner = module._read_cells

    def reads(root, side, job):
        read.append(job[1])
        return inner(root, side, job)

    monkeypatch.setattr(module, "_read_cells", reads)
    found = find(objects_like(library, (CHAIR, "bench")), library)
    assert found.objects.model_id == (f"{CHAIR}/bench",)
    # It fits perfectly, and no other has its proportions.
    assert read == [f"{CHAIR}/bench"]


def test_the_order_of_results_does_not_matter(library, monkeypatch):
    objects = objects_like(library, *MODELS, noise=0.2)
    expected = find(objects, library).objects.model_id
    monkeypatch.setattr(module, "work_on", lambda jobs, read, **_: map(read, reversed(jobs)))
    assert find(objects, library).objects.model_id == expected


def test_of_equals_the_first_by_name(tmp_path):
    for name in "cab":
        write_cad(tmp_path, CHAIR, name, MODELS[CHAIR, "armchair"])
    objects = objects_like(tmp_path, (CHAIR, "b"), noise=0.1)
    assert find(objects, tmp_path).objects.model_id == (f"{CHAIR}/a",)


def test_a_class_without_models_and_damaged_ones(tmp_path, library, caplog):
    caplog.set_level("INFO")
    write_cad(tmp_path, CHAIR, "good", MODELS[CHAIR, "bench"])
    write_cad(tmp_path, CHAIR, "flat", [[[0, 0, 0], [1, 1, 0]]])
    for name, kind in (("cut", "obj"), ("lost", "json")):
        write_cad(tmp_path, CHAIR, name, MODELS[CHAIR, "armchair"])
        path = tmp_path / CHAIR / name / "models" / f"model_normalized.{kind}"
        path.write_text("v 0 0 0\n") if kind == "obj" else path.unlink()
    found = find(objects_like(library, (TABLE, "cube"), (CHAIR, "armchair")), tmp_path)
    assert found.objects.model_id == ("", f"{CHAIR}/good")
    assert found.alignments().id_cad == ("good",)
    assert [mesh is None for mesh in found.meshes()] == [True, False]
    assert f"for 1 of 2 objects; {tmp_path} has no CAD model of class table" in caplog.text
    assert "left out 3 CAD models" in caplog.text


def test_nothing_predicted_and_no_library(library, tmp_path):
    found = find(ObjectSet.empty(), library)
    assert (len(found.alignments()), found.meshes()) == (0, [])
    with pytest.raises(DataError, match=r"no CAD model of ShapeNetCore .* give the folder that holds"):
        find(ObjectSet.empty(), tmp_path)


def test_a_real_annotation_comes_back(shared_dir):
    """The poses of annotated CAD models follow from their boxes, to a micrometre."""
    root = shared_dir / "realdata" / "scene0470_00"
    scene = read_annotations(root / "scan2cad" / "full_annotations.json")["scene0470_00"]
    objects, truth = scene_objects(scene), scene_alignments(scene)
    meshes = [read_mesh(root / "shapenet", *name.split("/")) for name in objects.model_id]
    shapes = np.stack([voxelize_solid(mesh.vertices, mesh.faces, size=SIDE) for mesh in meshes])
    given = replace(objects, shape=torch.from_numpy(shapes).float(), model_id=())
    found = find(given, root / "shapenet").alignments()
    assert len(model_names(root / "shapenet", CHAIR)) == 4
    assert found.model_id == truth.model_id
    torch.testing.assert_close(found.translation, truth.translation, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.scale, truth.scale, rtol=0, atol=1e-6)
    turns = (found.quaternion * truth.quaternion).sum(dim=1).abs()
    torch.testing.assert_close(turns, torch.ones_like(turns), rtol=0, atol=1e-9)
