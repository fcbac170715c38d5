# SPDX-License-Identifier: Apache-2.0
"""The structs of tensors that cross folders: what a batch, a network output and a prediction hold.

Shape letters, used in every docstring of the project:

====== =============================================== ====== ==================================
``B``  scenes in a batch                               ``X Y Z`` voxels along the world's axes
``N``  views (video frames) of a scene                 ``C``     channels of a feature
``H W`` rows and columns of an image                   ``P``     pixel-voxel pairs
``h w`` rows and columns of a feature map (stride 16)  ``Q``     object queries
``M``  objects                                         ``K``     classes without padding
``S``  cells along one side of a shape grid (63)       ``L``     decoder layers
====== =============================================== ====== ==================================

Units, frames and signs are in ``CONVENTIONS.md``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache, wraps
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

from raytran.classes import OTHER, PAPER_CLASSES, SCAN2CAD_CLASS_BY_CATID, Classes
from raytran.errors import DataError

SHAPE_SIZE: int = 63
"""Cells along each side of an object's shape grid (RayTran §3.2)."""

_MOST_LINES = 100
"""Objects of a set that are printed."""

SYMMETRY_INFINITE: int = 0
"""Value of ``ObjectSet.symmetry`` for a body of revolution; 1, 2 and 4 are the number of equal turns."""


_Made = TypeVar("_Made")
_Struct = TypeVar("_Struct", bound="TensorStruct")


@dataclass(frozen=True)
class TensorStruct:
    """A frozen dataclass of tensors (or of structs, or tuples of them) that moves between devices as one."""

    def to(self: _Struct, device: torch.device | str, *, non_blocking: bool = False) -> _Struct:
        """Return a copy with every tensor inside on ``device``."""
        return self._map(lambda item: item.to(device, non_blocking=non_blocking))

    def detach(self: _Struct) -> _Struct:
        """Return the same tensors without their autograd graph."""
        return self._map(lambda item: item.detach())

    def pin_memory(self: _Struct) -> _Struct:
        """Return a copy with every tensor inside in page-locked memory (called by ``DataLoader``)."""
        return self._map(lambda item: item.pin_memory())

    def _map(self: _Struct, change: Callable[[Any], Any]) -> _Struct:
        def visit(value: Any) -> Any:
            if isinstance(value, Tensor | TensorStruct):
                return change(value)
            return tuple(visit(item) for item in value) if isinstance(value, tuple) else value

        return replace(self, **{field.name: visit(getattr(self, field.name)) for field in fields(self)})

    def _select(self: _Struct, count: int, index: Tensor) -> _Struct:
        """Return rows of a struct whose fields all have ``count`` rows, or none."""
        chosen = torch.arange(count, device=index.device)[index].tolist()

        def pick(value: Any) -> Any:
            if isinstance(value, tuple):
                return tuple(value[i] for i in chosen) if value else ()
            return value if value is None or isinstance(value, Classes) else value[index]

        return replace(self, **{field.name: pick(getattr(self, field.name)) for field in fields(self)})


def cached(struct: TensorStruct, name: str, make: Callable[[], _Made]) -> _Made:
    """Return what ``make`` returned when ``struct`` was first asked for ``name``.

    Not ``functools.cached_property``: until Python 3.12 it holds a lock, through which ``torch.compile``
    cannot pass.
    """
    if not hasattr(struct, name):
        object.__setattr__(struct, name, make())
    return getattr(struct, name)


def sent_to(device: torch.device, tensor: Tensor) -> Tensor:
    """Return a tensor of the CPU on ``device``, by way of page-locked memory: the host does not wait."""
    if device.type in ("cpu", "mps") or torch.compiler.is_compiling():
        return tensor.to(device)
    return tensor.pin_memory().to(device, non_blocking=True)


class HostCopy:
    """A copy of a tensor on the host, for which it waits when it is asked for, and not before.

    Args:
        tensor: on any device.
    """

    def __init__(self, tensor: Tensor) -> None:
        waits = tensor.device.type in ("cpu", "mps")
        self._values = tensor.to("cpu", non_blocking=not waits)
        self._copied: Any = None
        backend: Any = None if waits else torch.get_device_module(tensor.device)
        if hasattr(backend, "Event"):
            self._copied = backend.Event()
            self._copied.record(backend.current_stream(tensor.device))

    def has_arrived(self) -> bool:
        """Say whether ``values`` would not wait."""
        return self._copied is None or self._copied.query()

    def values(self) -> Tensor:
        """Return the copy."""
        if self._copied is not None:
            self._copied.synchronize()
        return self._values


_Make = TypeVar("_Make", bound=Callable[..., Any])


def kept_on_device(most: int) -> Callable[[_Make], _Make]:
    """Let a function of plain values and ``device`` make its tensor once for each of them, not in every step.

    On the CPU and in compiled code it is made anew: there it costs little, and may be a tensor without data.
    Nobody may change what is kept.

    Args:
        most: results to keep.
    """

    def decorate(make: _Make) -> _Make:
        @lru_cache(maxsize=most)
        def kept(*values: Any, device: torch.device) -> Any:
            with torch.inference_mode(False), torch.no_grad():
                return make(*values, device=device)

        call = lambda *values, device: (  # noqa: E731
            make if device.type == "cpu" or torch.compiler.is_compiling() else kept
        )(*values, device=device)
        return cast("_Make", wraps(make)(call))

    return decorate


@kept_on_device(64)
def constant(values: tuple[float, ...], dtype: torch.dtype, *, device: torch.device) -> Tensor:
    """Return fixed numbers as a vector, for which the host never waits."""
    return sent_to(device, torch.tensor(values, dtype=dtype))


@dataclass(frozen=True)
class Views(TensorStruct):
    """Posed images of ``B`` scenes.

    Attributes:
        images: ``(B, N, 3 or 4, H, W)`` RGB, uint8 in [0, 255] or floating point in [0, 1]; a fourth
            channel is a foreground mask given as input (RayTran §4, "Perfect segmentation").
        intrinsics: ``(B, N, 3, 3)`` camera matrices for images of size ``H × W``, in pixels.
        world_from_camera: ``(B, N, 4, 4)`` poses.
        picture: ``(B, N, 4)`` left, top, right and bottom of what the camera took within each image, pixels;
            around it the image is filled up and nothing is read there. None: every image is all picture.
    """

    images: Tensor
    intrinsics: Tensor
    world_from_camera: Tensor
    picture: Tensor | None = None

    @property
    def image_size(self) -> tuple[int, int]:
        """``(H, W)`` of the images."""
        return self.images.shape[-2], self.images.shape[-1]

    def select(self, frames: slice | Tensor) -> Views:
        """Return some of the N views of each scene.

        Args:
            frames: which, a slice or an int64 or bool tensor over N.
        """
        picture = None if self.picture is None else self.picture[:, frames]
        return Views(
            self.images[:, frames], self.intrinsics[:, frames], self.world_from_camera[:, frames], picture
        )

    def scene(self, index: int = 0) -> Views:
        """Return the views of one scene, without the leading dimension: images are ``(N, 3 or 4, H, W)``."""
        picture = None if self.picture is None else self.picture[index]
        return Views(self.images[index], self.intrinsics[index], self.world_from_camera[index], picture)

    def colors(self) -> Tensor:
        """Return red, green and blue in [0, 1], ``(B, N, 3, H, W)`` in floating point."""
        rgb = self.images[:, :, :3]
        return rgb if rgb.is_floating_point() else rgb.float() / 255


@dataclass(frozen=True, repr=False)
class ObjectSet(TensorStruct):
    """The ``M`` objects of one scene, true or predicted, in the world of the scene's poses.

    Attributes:
        label: ``(M,)`` int64, index into ``classes.names``.
        center: ``(M, 3)`` centre of the object's box, metres.
        size: ``(M, 3)`` full extents along the object's own axes (x width, y height, z depth), metres.
        rotation: ``(M, 3, 3)`` world_from_object; if upright ``Rz(yaw) · B`` (``geometry.rotation``).
        symmetry: ``(M,)`` int64, number of equal turns about the object's up axis: 1, 2, 4, or
            ``SYMMETRY_INFINITE``. All ones for predictions.
        score: ``(M,)`` confidence in [0, 1]; ones for ground truth.
        shape: ``(M, S, S, S)`` or None, occupancy over the object's own box, indexed [x, y, z] in the object
            frame; cell ``i`` spans ``[i/S - ½, (i+1)/S - ½] · size``. bool for ground truth, probability
            in [0, 1] for predictions. A true shape without any cell is not known: only its box is.
        model_id: ``catid/id`` of each object's CAD model, or empty.
        num_views: ``(M,)`` how many views saw each object's box, the mean over the box; None if not counted.
        classes: what the labels stand for.
    """

    label: Tensor
    center: Tensor
    size: Tensor
    rotation: Tensor
    symmetry: Tensor
    score: Tensor
    shape: Tensor | None = None
    model_id: tuple[str, ...] = ()
    num_views: Tensor | None = None
    classes: Classes = PAPER_CLASSES

    def __len__(self) -> int:
        return int(self.label.shape[0])

    def __repr__(self) -> str:
        """Return a line for each object, and no tensors; on a GPU the host waits for them."""
        count = "1 object" if len(self) == 1 else f"{len(self)} objects"
        if not len(self):
            return count
        width = max(len(name) for name in self.category)
        lines = [
            f"{count}\n      {'class':{width}}  score   centre x, y, z in m       width x height x depth in m"
        ]
        numbers = torch.cat([self.score[:, None], self.center, self.size], dim=1).tolist()
        for i, (name, (score, x, y, z, *size)) in enumerate(zip(self.category, numbers, strict=True)):
            if i == _MOST_LINES:
                lines.append(f"  and {len(self) - i} more")
                break
            sides = " x ".join(f"{length:.2f}" for length in size)
            lines.append(f"  {i:02d}  {name:{width}}  {score:5.2f}  {x:7.2f} {y:7.2f} {z:7.2f}    {sides}")
        return "\n".join(lines)

    @property
    def category(self) -> tuple[str, ...]:
        """Name of each object's class; on a GPU the host waits for the labels."""
        return self.classes.names_of(self.label.tolist())

    def check_classes(self, classes: Classes, whose: str) -> None:
        """Raise unless the labels stand for ``classes``; without objects there are none.

        Args:
            classes: what they must stand for.
            whose: whose classes these are, e.g. ``the network``.

        Raises:
            DataError: they stand for others.
        """
        if len(self) and self.classes.names != classes.names:
            raise DataError(
                f"objects are of {classes.difference(self.classes)}, and {whose} has {len(classes)} "
                f"({classes}): give both the same classes"
            )

    def select(self, index: Tensor) -> ObjectSet:
        """Return the objects at ``index``, an int64 ``(M',)`` or bool ``(M,)`` tensor, in that order."""
        return self._select(len(self), index)

    @staticmethod
    def empty(classes: Classes = PAPER_CLASSES) -> ObjectSet:
        """Return a set of no objects."""
        none = torch.zeros(0, dtype=torch.int64)
        vectors = torch.zeros(0, 3)
        return ObjectSet(none, vectors, vectors, torch.zeros(0, 3, 3), none, torch.zeros(0), classes=classes)

    @staticmethod
    def join(sets: Sequence[ObjectSet]) -> ObjectSet:
        """Return the objects of several sets, at least one, in one, one set after another.

        Shapes, CAD models and numbers of views are kept if all sets that have objects have them.

        Raises:
            DataError: the sets do not have the same classes.
        """
        for objects in sets:
            if (difference := sets[0].classes.difference(objects.classes)) is not None:
                raise DataError(
                    f"objects of {len(sets[0].classes)} classes cannot stand in one set with objects of "
                    f"{difference}: read them with the same classes"
                )
        some = [objects for objects in sets if len(objects)] or list(sets[:1])

        def joined(name: str) -> Any:
            values = [getattr(objects, name) for objects in some]
            if name == "classes":
                return values[0]
            if name == "model_id":
                return tuple(one for value in values for one in value) if all(values) else ()
            return None if any(value is None for value in values) else torch.cat(values)

        return ObjectSet(**{field.name: joined(field.name) for field in fields(ObjectSet)})


@dataclass(frozen=True)
class CadAlignments(TensorStruct):
    """The ``M`` CAD models that stand in one scan, true or predicted, in the order of their file.

    A point of ShapeNet's ``model_normalized.obj`` goes to ``translation + R(quaternion) · (scale · point)``
    in the scan, the world of its poses. Numbers are float64.

    Attributes:
        catid: ShapeNet category of each model, eight digits.
        id_cad: name of each model within its category.
        translation: ``(M, 3)`` where the CAD's origin stands, metres.
        quaternion: ``(M, 4)`` [w, x, y, z] as given, of any length and either sign.
        scale: ``(M, 3)`` metres per CAD unit.
        score: ``(M,)`` confidence; ones for ground truth.
        half_extent: ``(M, 3)`` half the size of the CAD's box, CAD units; None for predictions without boxes.
        center: ``(M, 3)`` centre of the CAD's box, CAD units; None for predictions.
        symmetry: ``(M,)`` int64 as in ``ObjectSet``; None for predictions.
        pose: ``(M, 4, 4)`` scan_from_cad as annotated; None for predictions.
        annotated_scale: ``(M, 3)`` scale as annotated, of either sign; None for predictions.
    """

    catid: tuple[str, ...]
    id_cad: tuple[str, ...]
    translation: Tensor
    quaternion: Tensor
    scale: Tensor
    score: Tensor
    half_extent: Tensor | None = None
    center: Tensor | None = None
    symmetry: Tensor | None = None
    pose: Tensor | None = None
    annotated_scale: Tensor | None = None

    def __len__(self) -> int:
        return len(self.catid)

    @property
    def model_id(self) -> tuple[str, ...]:
        """``catid/id`` of each model."""
        return tuple(f"{catid}/{name}" for catid, name in zip(self.catid, self.id_cad, strict=True))

    @property
    def category(self) -> tuple[str, ...]:
        """Class of each model, of Scan2CAD's nine."""
        return tuple(SCAN2CAD_CLASS_BY_CATID.get(catid, OTHER) for catid in self.catid)

    def select(self, index: Tensor) -> CadAlignments:
        """Return the models at ``index``, an int64 ``(M',)`` or bool ``(M,)`` tensor, in that order."""
        return self._select(len(self), index)

    @staticmethod
    def empty() -> CadAlignments:
        """Return the predictions of a scene in which nothing was found."""
        none = torch.zeros(0, 10, dtype=torch.float64)
        return CadAlignments((), (), none[:, :3], none[:, :4], none[:, :3], none[:, 0])


@dataclass(frozen=True)
class SceneBatch(TensorStruct):
    """Input and targets of ``B`` scenes. Targets that were not asked for are None.

    Attributes:
        scene_id: name of each scene, e.g. ``scene0470_00``.
        views: the posed images.
        frame_id: per scene, the name of each frame's file without its ending.
        grid_center: ``(B, 3)`` centre of each scene's voxel grid, metres: the mean camera position.
        objects: the annotated objects of each scene.
        occupancy: ``(B, X, Y, Z)`` bool, voxel holds part of an object.
        foreground: ``(B, N, H, W)`` bool, amodal mask of all objects together.
        new_views: other posed images of the scenes, to be rendered from ``views``.
    """

    scene_id: tuple[str, ...]
    views: Views
    frame_id: tuple[tuple[str, ...], ...]
    grid_center: Tensor
    objects: tuple[ObjectSet, ...] | None = None
    occupancy: Tensor | None = None
    foreground: Tensor | None = None
    new_views: Views | None = None


@dataclass(frozen=True)
class RawObjects(TensorStruct):
    """Output of one decoder layer for every query.

    Attributes:
        class_logits: ``(B, Q, K + 1)``, padding last.
        center: ``(B, Q, 3)`` box centre in the world, metres.
        log_size: ``(B, Q, 3)`` natural logarithm of the sizes in metres.
        yaw_vector: ``(B, Q, 2)`` (sin, cos) of the yaw, not normalised.
        embedding: ``(B, Q, C)`` query embedding, from which shapes are decoded; for a shape head that reads
            boxes (``BoxVoxelShapeHead``) with what it reads there behind it.
    """

    class_logits: Tensor
    center: Tensor
    log_size: Tensor
    yaw_vector: Tensor
    embedding: Tensor

    def in_float32(self) -> RawObjects:
        """Return the predictions in float32, but for the embedding: it goes back into the network."""
        exact = {f.name: getattr(self, f.name).float() for f in fields(self) if f.name != "embedding"}
        return replace(self, **exact)

    @staticmethod
    def stack(layers: Sequence[RawObjects]) -> RawObjects:
        """Return layers as one, ``(L, B, Q, ...)``."""
        return RawObjects(
            *(torch.stack([getattr(one, f.name) for one in layers]) for f in fields(RawObjects))
        )


@dataclass(frozen=True)
class RawProposals(TensorStruct):
    """What every voxel says about an object centred in it: where proposal queries come from.

    Attributes:
        anchor: ``(B, X, Y, Z, 3)`` centre of each voxel in the world, metres.
        class_logits: ``(B, X, Y, Z, K)`` logits, one per class, of an object's centre lying in the voxel.
        center: ``(B, X, Y, Z, 3)`` box centre in the world, metres.
        log_size: ``(B, X, Y, Z, 3)`` natural logarithm of the sizes in metres.
        yaw_vector: ``(B, X, Y, Z, 2)`` (sin, cos) of the yaw, not normalised.
    """

    anchor: Tensor
    class_logits: Tensor
    center: Tensor
    log_size: Tensor
    yaw_vector: Tensor


@dataclass(frozen=True)
class RawScene(TensorStruct):
    """What the network returns for the tasks it was asked to do; None for the others.

    Attributes:
        grid_center: ``(B, 3)`` centre of the voxel grids used, metres.
        occupancy: ``(B, X, Y, Z)`` logits.
        foreground: ``(B, N, H, W)`` logits.
        objects: one ``RawObjects`` per decoder layer, last layer last.
        proposals: where the queries of ``objects`` come from; None if they are learned.
        new_views: ``(B, V, 3, H, W)`` logits of red, green and blue.
        denoising: as ``objects``, for noisy copies of the true ones; query i is a copy of object i modulo M.
        voxels: ``(B, X, Y, Z, C)`` features that the heads read, for heads of your own.
    """

    grid_center: Tensor
    occupancy: Tensor | None = None
    foreground: Tensor | None = None
    objects: tuple[RawObjects, ...] | None = None
    proposals: RawProposals | None = None
    new_views: Tensor | None = None
    denoising: tuple[RawObjects, ...] | None = None
    voxels: Tensor | None = None


@dataclass(frozen=True, repr=False)
class ScenePrediction(TensorStruct):
    """The result for one scene.

    The objects' class names are ``objects.category``; printed, it is a table.

    Attributes:
        scene_id: name of the scene.
        objects: predicted objects, highest score first, with ``shape`` probabilities if they were decoded.
        grid_center: ``(3,)`` centre of the voxel grid, metres.
        occupancy: ``(X, Y, Z)`` probability, or None.
        foreground: ``(N, H, W)`` probability, or None.
        seen: ``(X, Y, Z)`` int32, how many views have a ray through each voxel, or None.
        new_views: ``(V, 3, H, W)`` rendered colours in [0, 1], or None.
        grid_extent: sizes of the voxel grid, metres, or None if there are no voxels.
    """

    scene_id: str
    objects: ObjectSet
    grid_center: Tensor
    occupancy: Tensor | None = None
    foreground: Tensor | None = None
    seen: Tensor | None = None
    new_views: Tensor | None = None
    grid_extent: tuple[float, float, float] | None = None

    def __repr__(self) -> str:
        """Return the objects, a line each, and what else there is; on a GPU the host waits for them."""
        has = [
            f"{name} {' x '.join(map(str, value.shape))}"
            for name in ("occupancy", "foreground", "seen", "new_views")
            if (value := getattr(self, name)) is not None
        ]
        if self.objects.shape is not None:
            has.insert(0, f"shapes of {self.objects.shape.shape[-1]} cells a side")
        name = f"ScenePrediction {self.scene_id}".rstrip()
        return f"{name}: {self.objects!r}" + (f"\n  with {', '.join(has)}" if has else "")

    def save(
        self,
        folder: str | Path,
        views: Views | None = None,
        *,
        frame_ids: Sequence[str] = (),
        mesh_error: float = 0.01,
        obj: bool = False,
    ) -> Path:
        """Write the files of ``raytran predict`` (docs/outputs.md), all or nothing.

        Args:
            folder: replaced if it is an earlier result.
            views: B = 1, what was given to ``predict``. Without them there are no pictures of the frames, and
                no cameras in the plan and in ``scene.glb``.
            frame_ids: name of each view; by default their numbers.
            mesh_error: farthest that a mesh may lie from the surface of its shape, metres; 0: every triangle.
            obj: write each mesh as OBJ too.

        Returns:
            ``folder``.

        Raises:
            ConfigError: ``folder`` holds something that is no earlier result, or ``mesh_error`` is no length.
            ShapeError: there are not as many names as views.
        """
        # Imported here: this and `show` reach right, as `raytran.load` does, when they are called.
        from raytran.run.predict.write_scene import save_prediction

        return save_prediction(Path(folder), self, views, frame_ids=frame_ids, mesh_error=mesh_error, obj=obj)

    def show(self, views: Views | None = None, *, height: int = 600) -> None:
        """Show it in a notebook, to turn and zoom; elsewhere in a new page of the browser.

        Args:
            views: B = 1, what was given to ``predict``, to see the frames too.
            height: of the picture in the notebook, pixels.

        Raises:
            ConfigError: viser is not installed (``pip install 'raytran[viewer]'``).
        """
        from raytran.run.predict.write_scene import show_prediction

        show_prediction(self, views, height=height)
