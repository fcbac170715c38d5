# SPDX-License-Identifier: Apache-2.0
"""Scenes on disk as a ``torch`` data set: the one path from files to ``SceneBatch``."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import accumulate
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from raytran.classes import Classes
from raytran.data.augment import Augmentation
from raytran.data.cache import MaskCache
from raytran.data.images import MIN_VIEWS
from raytran.data.scan import scan_views
from raytran.data.scan2cad import SceneAnnotation, annotation_path, read_annotations
from raytran.data.scannet.scan import Scan
from raytran.data.scene_list import (
    ObjectTable,
    RecentScans,
    annotated,
    annotated_objects,
    choose_scenes,
    read_split,
)
from raytran.data.shapenet.models import has_own_shape
from raytran.data.targets import (
    foreground_masks,
    scene_occupancy,
    seen_objects,
    shape_grids,
    visible_masks,
)
from raytran.data.views import choose_even, choose_random, hold_out
from raytran.errors import ConfigError, DataError
from raytran.geometry.camera import Cameras
from raytran.geometry.grid import VoxelGrid, checked_grid
from raytran.setting_limits import check_settings
from raytran.structs import ObjectSet, SceneBatch, Views

TARGETS: tuple[str, ...] = ("objects", "shapes", "occupancy", "foreground")
"""Targets a data set can give; "shapes" gives the objects too."""

OBJECT_CHOICES = ("all", "in_volume", "seen")
INPUT_MASKS = ("amodal", "visible")

SCAN_MESH = "{}_vh_clean_2.ply"
"""Name of a scan's mesh in ScanNet's release."""

_MAX_SCAN_BYTES = 64 * 2**20
"""Memory of each process for cameras and file names: 300,000 frames, all of ScanNet at 200 a scan."""

_DROPOUT, _AUGMENTATION, _HELD_OUT = 1, 2, 3
"""Purposes of random numbers, besides the choice of frames."""


class _Randomness(NamedTuple):
    """What the random choices for one scene depend on, and nothing else."""

    seed: int
    epoch: int
    scene: int

    def generator(self, *purpose: int) -> torch.Generator:
        """Return the source of random numbers for a purpose."""
        state = np.random.SeedSequence([*self, *purpose]).generate_state(1, np.uint64)
        return torch.Generator().manual_seed(int(state[0] >> np.uint64(1)))


class SceneDataset(Dataset[SceneBatch]):
    """Scans with their annotation; item i, or (epoch, i), is a ``SceneBatch`` with B = 1.

    Nothing but the annotation is read before an item is asked for. Targets are cached on disk, the cameras of
    the latest scans in memory, so the data set stays small and is quick to send to the workers of a
    ``DataLoader``. Random frames and augmentation depend on the seed, the epoch and the index alone. The
    epoch comes with the index, because workers may be in different epochs. A scan of fewer than N frames
    gives some of them more than once, so that every scene has N images.

    Args:
        scans_root: folder of the scans, ``…/scannet/scans``.
        scene_ids: scans to take; if None all in ``scans_root`` that have objects in the annotation, if given.
        annotations: Scan2CAD's ``full_annotations.json``, or what ``read_annotations`` made of it; may be
            None if there are no targets.
        shapenet_root: folder of ShapeNet's categories; needed for all targets but "objects".
        cache_dir: where targets are cached.
        image_size: ``(H, W)`` to which images are resized, whatever their aspect.
        num_views: N.
        num_new_views: V, further frames of each scene, given as ``new_views``.
        view_choice: ``"random"`` or ``"even"``.
        grid_resolution: ``(X, Y, Z)`` of the occupancy target.
        grid_extent: sizes of its grid, metres; the grid is centred on the mean of the cameras.
        targets: some of ``TARGETS``.
        object_choice: which annotated objects are the targets "objects" and "shapes": ``"all"`` of the scan;
            ``"in_volume"``, those whose box centre lies in the voxel grid, after augmentation; or ``"seen"``,
            those that one of the N frames sees (``seen_objects``). Other targets are always of all objects.
        input_mask: mask of all objects as a fourth channel of the images: None, ``"amodal"``
            (``foreground_masks``), or ``"visible"`` (``visible_masks``, from a mesh in each scan's folder).
        min_views: fewest different frames of a scene.
        augmentation: random changes of each scene, for training; None for none.
        seed: of the random frames and of the augmentation.
        classes: of the objects, or their settings, see ``Classes.of``; None: the paper's nine. Annotated
            objects of no class are left out of all targets, as if they were not annotated.

    Raises:
        ConfigError: unknown targets, a target whose files are not given, a number that cannot be, or classes
            that are none.
        DataError: a file or scan is missing, no scene has objects, or none of them has a class.
    """

    def __init__(
        self,
        *,
        scans_root: Path,
        cache_dir: Path,
        scene_ids: Sequence[str] | None = None,
        annotations: Path | Mapping[str, SceneAnnotation] | None = None,
        shapenet_root: Path | None = None,
        image_size: tuple[int, int] = (480, 640),
        num_views: int = 20,
        num_new_views: int = 0,
        view_choice: Literal["random", "even"] = "random",
        grid_resolution: tuple[int, int, int] = (48, 48, 16),
        grid_extent: tuple[float, float, float] = (9.0, 9.0, 3.5),
        targets: Collection[str] = TARGETS,
        object_choice: Literal["all", "in_volume", "seen"] = "all",
        input_mask: Literal["amodal", "visible"] | None = None,
        min_views: int = MIN_VIEWS,
        augmentation: Augmentation | None = None,
        seed: int = 0,
        classes: Classes | Mapping[str, Any] | None = None,
    ) -> None:
        _check(targets, annotations, shapenet_root, input_mask=input_mask, object_choice=object_choice)
        check_settings({"image_size": image_size, "num_views": num_views, "num_new_views": num_new_views})
        checked_grid(grid_resolution, grid_extent)
        if view_choice not in ("random", "even"):
            raise ConfigError(f"unknown view_choice {view_choice!r}: choose random or even")
        if isinstance(annotations, str | Path):
            annotations = read_annotations(Path(annotations))
        self.scene_ids = choose_scenes(Path(scans_root), scene_ids, annotations)
        self._scans = RecentScans(Path(scans_root), _MAX_SCAN_BYTES)
        self.classes = Classes.of(classes)
        self._objects_of = ObjectTable(annotated_objects(annotations, self.scene_ids, self.classes))
        self._shapenet_root = None if shapenet_root is None else Path(shapenet_root)
        self._cache = MaskCache(folder=Path(cache_dir))
        self._image_size = (int(image_size[0]), int(image_size[1]))
        # The frames to be rendered are chosen, read and augmented along with the others.
        self._num_views, self._num_new_views = num_views + num_new_views, num_new_views
        self._min_views = min_views + num_new_views
        self._view_choice = view_choice
        self._grid_resolution, self._grid_extent = grid_resolution, grid_extent
        self._targets = frozenset(targets)
        self._object_choice = object_choice
        self._input_mask = input_mask
        self._augmentation = augmentation
        self._seed = seed

    def __len__(self) -> int:
        return len(self.scene_ids)

    def num_objects(self, index: int) -> int:
        """Return how many objects scene ``index`` has, without reading the scene."""
        return len(self._objects_of[index])

    def has_shapes(self) -> bool:
        """Return whether of any object more than the box is known, without reading a scene."""
        return any(has_own_shape(name) for i in range(len(self)) for name in self._objects_of[i].model_id)

    def __getitem__(self, item: int | tuple[int, int]) -> SceneBatch:
        """Return a scene with B = 1.

        Args:
            item: index of the scene, or (epoch, index); without an epoch it is 0.

        Raises:
            DataError: the scan, its images or the CAD models cannot be read.
        """
        epoch, index = item if isinstance(item, tuple) else (0, item)
        randomness = _Randomness(self._seed, epoch, index)
        scan = self._scans[self.scene_ids[index]]
        views, used = scan_views(
            scan, self._choose(len(scan), randomness), image_size=self._image_size, min_views=self._min_views
        )
        seen, rendered = self._hold_out(used, randomness)
        scene = self._scene(scan, views, used, seen, self._with_shapes(self._objects_of[index]))
        # Which objects the frames see is decided before augmentation: it depends on the cameras as on disk.
        is_seen = self._seen_objects(scene, seen)
        if self._augmentation is not None:
            scene = self._augmentation(scene, randomness.generator(_AUGMENTATION))
        if rendered:
            scene = _hold_out_views(scene, seen, rendered)
        (objects,) = scene.objects or (ObjectSet.empty(self.classes),)
        targets = None
        if self._targets & {"objects", "shapes"}:
            known = _with_known_shapes(objects, self._objects_of[index].model_id)
            targets = (self._target_objects(known, is_seen, scene.grid_center),)
        return replace(
            scene,
            objects=targets,
            occupancy=self._occupancy(objects, scene.grid_center[0]),
            foreground=scene.foreground if "foreground" in self._targets else None,
        )

    def _scene(
        self, scan: Scan, views: Views, used: Sequence[int], seen: Sequence[int], objects: ObjectSet
    ) -> SceneBatch:
        """Return all N + V frames of a scene before augmentation, with all objects and the masks."""
        cameras = Cameras.of(views.scene())
        foreground = self._foreground(objects, cameras)
        mask = self._visible(objects, cameras, scan) if self._input_mask == "visible" else foreground
        if self._input_mask is not None and mask is not None:
            channel = mask[:, :, None].byte() * 255
            views = replace(views, images=torch.cat([views.images, channel], dim=2))
        return SceneBatch(
            scene_id=(scan.scene_id,),
            views=views,
            frame_id=(tuple(scan.frame_id[i] for i in used),),
            grid_center=cameras.position[seen].mean(dim=0, keepdim=True),
            objects=(objects,),
            foreground=foreground,
        )

    def _choose(self, n: int, randomness: _Randomness) -> list[int]:
        if self._view_choice == "even":
            chosen = choose_even(n, self._num_views).tolist()
        else:
            chosen = choose_random(n, self._num_views, randomness.generator()).tolist()
        if self._augmentation is None:
            return chosen
        return self._augmentation.drop_frames(chosen, self._min_views, randomness.generator(_DROPOUT))

    def _hold_out(self, used: Sequence[int], randomness: _Randomness) -> tuple[list[int], list[int]]:
        """Return the positions in ``used`` of the frames to see and of those to render."""
        if not self._num_new_views:
            return list(range(len(used))), []
        generator = None if self._view_choice == "even" else randomness.generator(_HELD_OUT)
        return hold_out(used, self._num_new_views, generator)

    def _with_shapes(self, objects: ObjectSet) -> ObjectSet:
        if self._shapenet_root is None or not self._targets & {"shapes", "occupancy"}:
            return objects
        shapes = shape_grids(objects.model_id, shapenet_root=self._shapenet_root, cache=self._cache)
        return replace(objects, shape=shapes)

    def _target_objects(self, objects: ObjectSet, is_seen: Tensor | None, grid_center: Tensor) -> ObjectSet:
        """Return the objects that are targets by ``object_choice``, with shapes if these are targets."""
        if "shapes" not in self._targets:
            objects = replace(objects, shape=None)
        if self._object_choice == "in_volume":
            half = torch.tensor(self._grid_extent, dtype=torch.float64) / 2
            return objects.select(((objects.center - grid_center).double().abs() <= half).all(dim=1))
        return objects if is_seen is None else objects.select(is_seen)

    def _seen_objects(self, scene: SceneBatch, seen: Sequence[int]) -> Tensor | None:
        """Return which objects the frames at ``seen`` see, ``(M,)`` bool; None if that is not asked for."""
        wanted = self._object_choice == "seen" and self._targets & {"objects", "shapes"}
        if not wanted or self._shapenet_root is None or scene.objects is None:
            return None
        views = scene.views.select(torch.tensor(seen))
        cameras = Cameras.of(views.scene())
        (objects,), root = scene.objects, self._shapenet_root
        return seen_objects(objects, cameras, shapenet_root=root, cache=self._cache).any(dim=0)

    def _occupancy(self, objects: ObjectSet, grid_center: Tensor) -> Tensor | None:
        if "occupancy" not in self._targets:
            return None
        grid = VoxelGrid(resolution=self._grid_resolution, extent=self._grid_extent, center=grid_center)
        return scene_occupancy(objects, grid)[None]

    def _foreground(self, objects: ObjectSet, cameras: Cameras) -> Tensor | None:
        wanted = self._input_mask == "amodal" or "foreground" in self._targets
        if self._shapenet_root is None or not wanted:
            return None
        return foreground_masks(objects, cameras, shapenet_root=self._shapenet_root, cache=self._cache)[None]

    def _visible(self, objects: ObjectSet, cameras: Cameras, scan: Scan) -> Tensor | None:
        if self._shapenet_root is None:
            return None
        paths = {
            "scan_mesh": scan.folder / SCAN_MESH.format(scan.scene_id),
            "shapenet_root": self._shapenet_root,
        }
        return visible_masks(objects, cameras, **paths, cache=self._cache)[None]


def scan2cad_dataset(root: Path, split: str, *, cache_dir: Path, **options: Any) -> SceneDataset:
    """Open one split of a data set laid out as ``root/{scannet,scan2cad,shapenet}``.

    The scans are those of ``scannet/scannetv2_<split>.txt`` that have objects in
    ``scan2cad/full_annotations.json``; without any split file, all that do and are in ``scannet/scans``.

    Args:
        root: folder of the three folders.
        split: ``"train"`` or ``"val"``.
        cache_dir: where targets are cached.
        options: further arguments of ``SceneDataset``.

    Raises:
        DataError: the layout is incomplete, or no scan of the split has objects.
    """
    root = Path(root)
    if not (root / "scannet" / "scans").is_dir():
        raise DataError(
            f"there is no folder {root / 'scannet' / 'scans'}: prepare the data set or mend its path"
        )
    listed = read_split(root / "scannet", split)
    path = annotation_path(root)
    annotations = read_annotations(path)
    with_objects = set(annotated(annotations))
    if not with_objects:
        raise DataError(f"there is no scene with objects in {path}: copy the whole file")
    scene_ids = None if listed is None else [scene_id for scene_id in listed if scene_id in with_objects]
    if scene_ids == []:
        raise DataError(
            f"no scene with objects in {path} is in the {split} split: "
            "check that annotation and split belong together"
        )
    return SceneDataset(
        scans_root=root / "scannet" / "scans",
        scene_ids=scene_ids,
        annotations=annotations,
        shapenet_root=root / "shapenet",
        cache_dir=cache_dir,
        **options,
    )


class JoinedScenes(Dataset[SceneBatch]):
    """The scenes of several data sets one after the other, each as its own data set gives it.

    Args:
        datasets: the data sets, of which each takes what ``SceneDataset`` takes.
    """

    def __init__(self, datasets: Sequence[Dataset[SceneBatch]]) -> None:
        self._datasets = tuple(datasets)
        self._ends = tuple(accumulate(len(dataset) for dataset in datasets))  # type: ignore[arg-type]

    def __len__(self) -> int:
        return self._ends[-1]

    def __getitem__(self, item: int | tuple[int, int]) -> SceneBatch:
        """Return a scene with B = 1; ``item`` is its index or (epoch, index)."""
        index = item[1] if isinstance(item, tuple) else item
        if not 0 <= index < len(self):
            raise IndexError(f"scene {index} of {len(self)}")
        number = bisect_right(self._ends, index)
        index -= self._ends[number - 1] if number else 0
        return self._datasets[number][(item[0], index) if isinstance(item, tuple) else index]

    def has_shapes(self) -> bool:
        """Return whether an object of any of the data sets has a known shape."""
        return any(getattr(dataset, "has_shapes", lambda: True)() for dataset in self._datasets)


class FewScenes(Dataset[SceneBatch]):
    """The first scenes of another data set, the same in every epoch: to overfit on.

    Args:
        dataset: the data set.
        num_scenes: number of scenes, at most.
    """

    def __init__(self, dataset: Dataset[SceneBatch], num_scenes: int) -> None:
        self._dataset = dataset
        self._length = min(num_scenes, len(dataset))  # type: ignore[arg-type]

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, item: int | tuple[int, int]) -> SceneBatch:
        """Return scene ``item``, or of (epoch, index) the scene ``index``, with B = 1."""
        index = item[1] if isinstance(item, tuple) else item
        if not 0 <= index < self._length:
            raise IndexError(f"scene {index} of {self._length}")
        return self._dataset[index]


def few_scenes(*, root: Path, num_scenes: int, **options: Any) -> FewScenes:
    """Return a few training scenes, always with the same evenly spread frames and without augmentation.

    Training and validation get the same scenes, so that a network can learn them by heart.

    Args:
        root: see ``scan2cad_dataset``.
        num_scenes: number of scenes.
        options: further arguments of ``scan2cad_dataset``; its split, choice of frames and augmentation are
            ignored.
    """
    fixed = options | {"split": "train", "view_choice": "even", "augmentation": None}
    return FewScenes(scan2cad_dataset(root=root, **fixed), num_scenes)


def _check(
    targets: Collection[str],
    annotations: object,
    shapenet_root: Path | None,
    *,
    input_mask: object,
    object_choice: str,
) -> None:
    unknown = set(targets) - set(TARGETS)
    if unknown:
        raise ConfigError(f"unknown targets {sorted(unknown)}: choose from {', '.join(TARGETS)}")
    if object_choice not in OBJECT_CHOICES:
        choices = ", ".join(OBJECT_CHOICES)
        raise ConfigError(f"unknown object_choice={object_choice}: choose one of {choices}")
    if input_mask not in (None, *INPUT_MASKS):
        raise ConfigError(f"unknown input_mask={input_mask}: choose one of {', '.join(INPUT_MASKS)}, null")
    mask = input_mask is not None
    if (targets or mask) and annotations is None:
        raise ConfigError("targets and input masks need annotations: give the path of full_annotations.json")
    if (set(targets) - {"objects"} or mask or object_choice == "seen") and shapenet_root is None:
        raise ConfigError(
            "shapes, occupancy, masks and the choice of seen objects need CAD models: give shapenet_root"
        )


def _hold_out_views(scene: SceneBatch, seen: Sequence[int], rendered: Sequence[int]) -> SceneBatch:
    """Return the scene with the views at positions ``seen``, and those at ``rendered`` as new views."""
    return replace(
        scene,
        views=scene.views.select(torch.tensor(seen)),
        new_views=scene.views.select(torch.tensor(rendered)),
        frame_id=tuple(tuple(names[position] for position in seen) for names in scene.frame_id),
        foreground=None if scene.foreground is None else scene.foreground[:, list(seen)],
    )


def _with_known_shapes(objects: ObjectSet, model_ids: Sequence[str]) -> ObjectSet:
    """Return the objects; of those of which only the box is known the shapes are empty: no target.

    Args:
        objects: M of them, as augmentation left them.
        model_ids: ``catid/id`` of each.
    """
    is_known = torch.tensor([has_own_shape(name) for name in model_ids], dtype=torch.bool)
    if objects.shape is None or bool(is_known.all()):
        return objects
    return replace(objects, shape=objects.shape & is_known[:, None, None, None])
