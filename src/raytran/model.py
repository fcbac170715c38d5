# SPDX-License-Identifier: Apache-2.0
"""RayTran: posed images of a room → its objects, with class, pose and shape (Tyszkiewicz et al., ECCV 2022).

This is the page to read first. The backbone lifts the images into a voxel grid (§3.1); heads read the
result (§3.2): what is occupied, what is foreground in each view, and which objects there are; or what the
scene looks like from elsewhere (appendix A).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from raytran.backbone.backbone import VoxelBackbone
from raytran.classes import Classes
from raytran.errors import ConfigError, ShapeError
from raytran.geometry.camera import Cameras
from raytran.geometry.checks import check_views
from raytran.geometry.grid import VoxelGrid, checked_grid
from raytran.heads.objects import ObjectOutputs, objects_of_queries
from raytran.heads.score_scaling import SCORE_THRESHOLD, ScoreScaling
from raytran.ops.pairs import Pairs
from raytran.ops.traverse import Attention, RayTracer, count_views
from raytran.setting_limits import check_settings
from raytran.structs import ObjectSet, RawScene, SceneBatch, ScenePrediction, Views

TASKS = ("occupancy", "foreground", "objects")
"""What ``forward`` is asked for by default; shapes are decoded afterwards, for chosen queries only."""

SHAPES_AT_ONCE = 16


def inputs_of(batch: SceneBatch) -> dict[str, Any]:
    """Return what ``RayTran.forward`` is given of a batch; of the new views that is their cameras alone."""
    return {
        "views": batch.views,
        "grid_center": batch.grid_center,
        "true_objects": batch.objects,
        "new_cameras": None if batch.new_views is None else Cameras.of(batch.new_views),
    }


class Traced(NamedTuple):
    """Where ``forward`` looks along rays: made before the network runs, which is then one graph of tensors.

    Attributes:
        grid_center: ``(B, 3)`` centres of the voxel grids, metres.
        pairs: of each chunk of views, the pixel-voxel pairs of all B scenes.
        new_pairs: those of the cameras to render; None without them.
        fits: ``()`` bool on the device, whether no pair of the views is missing; None if none is.
    """

    grid_center: Tensor
    pairs: tuple[Pairs, ...]
    new_pairs: Pairs | None = None
    fits: Tensor | None = None


class RayTran(nn.Module):
    """The network.

    Args:
        backbone: images and pixel-voxel pairs → voxel and pixel features.
        heads: ``occupancy``, ``foreground``, ``objects``, ``shape`` and ``view``, or those that are needed.
        grid_resolution: ``(X, Y, Z)`` voxels.
        grid_extent: sizes of the voxel grid, metres.
        rays_per_cell: n×n rays join a cell of the feature map with the voxels they cross.
        attention: what computes ray-traced attention: ``fused`` Triton kernels, products of ``torch.sparse``
            (``sparse``), or the former where they run and the latter elsewhere (``auto``).
        classes: of the objects, or their settings, see ``Classes.of``; None: the paper's nine.
        score_scaling: from the probability of an object's class to its score, or its settings, see
            ``ScoreScaling``; None: they are one. It is fitted to a network that is trained.

    Raises:
        ConfigError: the foreground or view head does not grow the features back to image size, there is no
            such attention, or no such voxel grid; classes are none, or the object head has another number.
    """

    def __init__(
        self,
        *,
        backbone: VoxelBackbone,
        heads: Mapping[str, nn.Module],
        grid_resolution: Sequence[int] = (48, 48, 16),
        grid_extent: Sequence[float] = (9.0, 9.0, 3.5),
        rays_per_cell: int = 2,
        attention: Attention = "auto",
        classes: Classes | Mapping[str, Any] | None = None,
        score_scaling: ScoreScaling | Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.classes = Classes.of(classes)
        self.score_scaling = ScoreScaling.of(score_scaling)
        # An object head of the user's own need not tell.
        of_head = getattr(heads["objects"], "num_classes", None) if "objects" in heads else None
        if of_head not in (None, len(self.classes)):
            raise ConfigError(
                f"the network has {len(self.classes)} classes and its object head {of_head}: name them in "
                "classes.names, from which both take them"
            )
        for name in ("foreground", "view"):
            if name in heads and heads[name].stride != backbone.stride:
                raise ConfigError(
                    f"the {name} head grows features {heads[name].stride}× and the encoder's stride is "
                    f"{backbone.stride}: give it one width for each halving but the last"
                )
        self.backbone = backbone
        self.heads = nn.ModuleDict(heads)
        self.grid_resolution, self.grid_extent = checked_grid(grid_resolution, grid_extent)
        check_settings({"rays_per_cell": rays_per_cell})
        self.rays_per_cell = rays_per_cell
        self.ray_tracer = RayTracer(attention)

    def forward(
        self,
        views: Views,
        *,
        tasks: Collection[str] = TASKS,
        grid_center: Tensor | None = None,
        views_at_once: int | None = None,
        new_cameras: Cameras | None = None,
        true_objects: Sequence[ObjectSet] | None = None,
        traced: Traced | None = None,
    ) -> RawScene:
        """Run the backbone once and the heads of ``tasks``.

        Args:
            views: posed images of B scenes.
            tasks: some of ``TASKS`` and ``view``.
            grid_center: ``(B, 3)`` centres of the voxel grids, metres; by default the mean camera position.
            views_at_once: views that pass through the network together, so that memory hardly grows with
                their number; for prediction only. None: all of them.
            new_cameras: what ``view`` renders, of leading shape ``(B, V)``; no other task sees them.
            true_objects: of the scenes, for object heads that learn from noisy copies of them in training; no
                other prediction depends on them.
            traced: what ``trace_views`` returned for the same views; None: they are traced here. Given, the
                network is one graph for ``torch.compile``.

        Returns:
            Raw predictions, None for what was not asked for.

        Raises:
            ConfigError: ``views_at_once`` is fewer than the views in training mode, or not positive; or
                ``view`` is asked for without new cameras, or of a network without that head.
            ShapeError: image sides are not divisible by the encoder's stride, or tensors do not have the
                documented shapes.
        """
        if traced is None:
            rendered = new_cameras if "view" in tasks else None
            traced = self.trace_views(
                views, grid_center=grid_center, views_at_once=views_at_once, new_cameras=rendered
            )
        voxels, pixels = self._run_backbone(views, traced, "foreground" in tasks, views_at_once)
        objects = ObjectOutputs(())
        if "objects" in tasks:
            objects = self.find_objects(voxels, self._grid(traced.grid_center), true_objects)
        return RawScene(
            grid_center=traced.grid_center,
            occupancy=self.heads["occupancy"](voxels) if "occupancy" in tasks else None,
            foreground=None if pixels is None else self._foreground(pixels),
            objects=objects.layers or None,
            proposals=objects.proposals,
            denoising=objects.denoising,
            new_views=self._render(voxels, traced, new_cameras) if "view" in tasks else None,
            voxels=voxels,
        )

    def find_objects(
        self, voxels: Tensor, grid: VoxelGrid, true_objects: Sequence[ObjectSet] | None = None
    ) -> ObjectOutputs:
        """Run the object head, and read the voxels in its boxes for a shape head that asks for them.

        Args:
            voxels: ``(B, X, Y, Z, C)`` features.
            grid: of the voxels, ``center`` ``(B, 3)``.
            true_objects: as in ``forward``.
        """
        objects: ObjectOutputs = self.heads["objects"](voxels, grid, true_objects)
        if "shape" not in self.heads:
            return objects
        read = getattr(self.heads["shape"], "with_box_voxels", None)
        if read is None:
            return objects
        return objects._replace(layers=tuple(read(layer, voxels, grid) for layer in objects.layers))

    def _grid(self, center: Tensor) -> VoxelGrid:
        return VoxelGrid(self.grid_resolution, self.grid_extent, center)

    def _run_backbone(
        self, views: Views, traced: Traced, with_pixels: bool, views_at_once: int | None
    ) -> tuple[Tensor, list[Tensor] | None]:
        """Return voxel features, and the pixel features of each chunk of views if they are wanted."""
        chunks = _in_chunks(views, views_at_once)
        # Nothing but a prediction has several chunks, and they have no gradient.
        with torch.set_grad_enabled(torch.is_grad_enabled() and len(chunks) == 1):
            return self.backbone(
                [chunk.images for chunk in chunks],
                [Cameras.of(chunk) for chunk in chunks],
                self._grid(traced.grid_center),
                traced.pairs,
                with_pixels=with_pixels,
            )

    def trace_views(
        self,
        views: Views,
        *,
        grid_center: Tensor | None = None,
        views_at_once: int | None = None,
        new_cameras: Cameras | None = None,
        wait: bool = True,
    ) -> Traced:
        """Return what ``forward`` reads along rays.

        Args:
            views: as in ``forward``, and so are the errors.
            grid_center: as there.
            views_at_once: as there.
            new_cameras: as there; their rays are traced wherever they are given.
            wait: the host may wait for the number of pairs. If not, some may be missing, see ``Traced.fits``.
        """
        center = Cameras.of(views).position.mean(dim=1) if grid_center is None else grid_center
        grid = self._grid(center)
        if not wait and views_at_once is None and new_cameras is None:
            pairs = self._trace(Cameras.of(views), grid, self.ray_tracer.without_waiting)
            return Traced(center, (pairs,), fits=self.ray_tracer.fits)
        of_chunks = [self.trace(Cameras.of(chunk), grid) for chunk in _in_chunks(views, views_at_once)]
        return Traced(center, tuple(of_chunks), self._trace_new(new_cameras, grid))

    def _trace_new(self, cameras: Cameras | None, grid: VoxelGrid) -> Pairs | None:
        """Return the pairs that the view head reads."""
        if cameras is None:
            return None
        stride = self.backbone.stride
        height, width = cameras.image_size
        if height % stride or width % stride:
            raise ShapeError(f"expected new cameras with sides divisible by {stride}, got {height}x{width}")
        # Along the rays, also where the backbone reads its features in another way.
        return self.ray_tracer(cameras, grid, (height // stride, width // stride), self.rays_per_cell)

    def trace(self, cameras: Cameras, grid: VoxelGrid) -> Pairs:
        """Return the pairs that the backbone reads, for cameras of leading shape ``(B, N)``."""
        return self._trace(cameras, grid, self.ray_tracer)

    def _trace(self, cameras: Cameras, grid: VoxelGrid, ray_tracer: Callable[..., Pairs]) -> Pairs:
        height, width = cameras.image_size
        stride = self.backbone.stride
        return self.backbone.trace(
            cameras,
            grid,
            (height // stride, width // stride),
            ray_tracer=ray_tracer,
            rays_per_cell=self.rays_per_cell,
        )

    def _foreground(self, pixels: Sequence[Tensor]) -> Tensor:
        logits = [self.heads["foreground"](chunk) for chunk in pixels]
        return logits[0] if len(logits) == 1 else torch.cat(logits, dim=1)

    def _render(self, voxels: Tensor, traced: Traced, cameras: Cameras | None) -> Tensor:
        """Run the view head."""
        if "view" not in self.heads or cameras is None or traced.new_pairs is None:
            missing = "new_cameras" if "view" in self.heads else "a view head: train experiment=novel_view"
            raise ConfigError(f"rendering new views needs {missing}")
        return self.heads["view"](voxels, cameras, self._grid(traced.grid_center), traced.new_pairs)

    def decode_shapes(self, embedding: Tensor) -> Tensor:
        """Return shape logits ``(M, S, S, S)`` of query embeddings ``(M, C)``, as ``RawObjects`` has them."""
        return self.heads["shape"](embedding)

    def class_layers(self) -> tuple[str, ...]:
        """Return the names of the parts whose size or meaning is that of the classes, as their modules say.

        A module of your own lists them, as seen from itself, in an attribute ``class_layers``.
        """
        return tuple(
            f"{name}.{part}"
            for name, module in self.named_modules()
            if module is not self
            for part in getattr(module, "class_layers", ())
        )

    def idle_modules(self, tasks: Collection[str]) -> tuple[str, ...]:
        """Return the names of the sub-modules that get no gradient when ``forward`` is asked for ``tasks``.

        A stage of training must freeze them; ``shape`` counts as a task.
        """
        heads = tuple(f"heads.{name}" for name in self.heads if name not in tasks)
        idle = self.backbone.idle_modules(with_pixels="foreground" in tasks)
        return heads + tuple(f"backbone.{name}" for name in idle)

    @property
    def score_threshold(self) -> float:
        """The score of an object to which the network gave a probability of ½: from there on objects count.

        Where scores are scaled it is another number and chooses the same objects.
        """
        return SCORE_THRESHOLD if self.score_scaling is None else self.score_scaling.of_half

    @torch.no_grad()
    def predict(
        self,
        views: Views,
        *,
        scene_id: str = "",
        score_threshold: float = 0.0,
        with_shapes: bool = True,
        views_at_once: int | None = None,
        grid_center: Tensor | None = None,
        check: bool = True,
    ) -> ScenePrediction:
        """Predict one scene (B = 1), counting the views of each voxel. Puts the network in eval mode.

        Args:
            views: posed images, batch dimension 1.
            scene_id: name to give the result.
            score_threshold: objects with a lower score are left out.
            with_shapes: decode the objects' shapes.
            views_at_once: views that pass through the network together, None for all; the same result up to
                rounding in less memory.
            grid_center: ``(3,)`` centre of the voxel grid, metres; by default the mean camera position.
            check: check the values in the tensors, as the commands do with those of files. On a GPU the host
                waits for that once, so leave it out where frames were checked before; types and shapes are
                checked in any case.

        Raises:
            ConfigError: ``views_at_once`` is not positive.
            DataError: views hold what no camera gives; the message names the first of them (``check_views``).
            ShapeError: a tensor does not have the documented shape.
        """
        self.eval()
        views = self._checked(views, grid_center, check)
        center = None if grid_center is None else grid_center[None].float()
        raw = self(views, views_at_once=views_at_once, grid_center=center)
        found = self.decode(raw, [scene_id], score_threshold=score_threshold, with_shapes=with_shapes)[0]
        return replace(found, seen=self._count_views(views, found.grid_center))

    @torch.no_grad()
    def render(
        self,
        views: Views,
        cameras: Cameras,
        *,
        views_at_once: int | None = None,
        grid_center: Tensor | None = None,
        check: bool = True,
    ) -> Iterator[Tensor]:
        """Render one scene (B = 1) from new cameras, a few at a time. Puts the network in eval mode.

        Args:
            views: posed images, batch dimension 1.
            cameras: of leading shape ``(1, V)``, in the world of ``views``, their sides divisible by the
                encoder's stride.
            views_at_once: views, old or new, that pass through the network together, None for all.
            grid_center: ``(3,)`` centre of the voxel grid, metres; None: the mean camera position.
            check: as of ``predict``.

        Yields:
            ``(n, 3, H, W)`` red, green and blue in [0, 1] of the next cameras.

        Raises:
            ConfigError: the network has no view head.
            DataError, ShapeError: as from ``predict``.
        """
        self.eval()
        views = self._checked(views, grid_center, check)
        center = None if grid_center is None else grid_center[None].float()
        traced = self.trace_views(views, grid_center=center, views_at_once=views_at_once)
        voxels, _ = self._run_backbone(views, traced, False, views_at_once)
        grid, count = self._grid(traced.grid_center), cameras.intrinsics.shape[1]
        for start in range(0, count, views_at_once or max(count, 1)):
            chunk = cameras.select(slice(start, start + (views_at_once or count)))
            along = traced._replace(new_pairs=self._trace_new(chunk, grid))
            yield self._render(voxels, along, chunk)[0].float().sigmoid()

    @torch.no_grad()
    def decode(
        self,
        raw: RawScene,
        scene_ids: Sequence[str],
        *,
        score_threshold: float = 0.0,
        with_shapes: bool = True,
    ) -> tuple[ScenePrediction, ...]:
        """Turn raw predictions of B scenes into objects, masks and occupancy; arguments as in ``predict``."""
        return tuple(
            ScenePrediction(
                scene_id=scene_id,
                objects=self._objects(raw, scene, score_threshold, with_shapes),
                grid_center=raw.grid_center[scene],
                occupancy=None if raw.occupancy is None else raw.occupancy[scene].float().sigmoid(),
                foreground=None if raw.foreground is None else raw.foreground[scene].float().sigmoid(),
                new_views=None if raw.new_views is None else raw.new_views[scene].float().sigmoid(),
                grid_extent=self.grid_extent,
            )
            for scene, scene_id in enumerate(scene_ids)
        )

    def _checked(self, views: Views, grid_center: Tensor | None, values: bool) -> Views:
        """Return the views of one scene in float32; raise unless they are such as the commands give."""
        check_views(
            views, channels=self.backbone.encoder.input_channels, grid_center=grid_center, values=values
        )
        images = views.images.float() if views.images.is_floating_point() else views.images
        cameras = Cameras.of(views).to(torch.float32)
        return Views(images, cameras.intrinsics, cameras.world_from_camera, cameras.picture)

    def _count_views(self, views: Views, grid_center: Tensor) -> Tensor:
        cameras = Cameras.of(views.scene())
        grid = VoxelGrid(self.grid_resolution, self.grid_extent, grid_center)
        stride = self.backbone.stride
        size = (views.image_size[0] // stride, views.image_size[1] // stride)
        return count_views(cameras, grid, size, self.rays_per_cell)

    def _objects(self, raw: RawScene, scene: int, score_threshold: float, with_shapes: bool) -> ObjectSet:
        if raw.objects is None:
            return ObjectSet.empty(self.classes).to(raw.grid_center.device)
        objects, embedding = objects_of_queries(
            raw.objects[-1],
            scene,
            score_threshold=score_threshold,
            classes=self.classes,
            score_scaling=self.score_scaling,
        )
        if not with_shapes or "shape" not in self.heads:
            return objects
        # What a forward pass under autocast left in 16 bits is decoded outside of it.
        embedding = embedding.to(next(self.heads["shape"].parameters()).dtype)
        chunks = [self.decode_shapes(chunk) for chunk in embedding.split(SHAPES_AT_ONCE)]
        return replace(objects, shape=torch.cat(chunks).float().sigmoid())


def _in_chunks(views: Views, views_at_once: int | None) -> list[Views]:
    """Return the views of each scene ``views_at_once`` at a time, all together for None.

    Raises:
        ConfigError: ``views_at_once`` is not positive.
    """
    if views_at_once is not None and views_at_once < 1:
        raise ConfigError(f"views_at_once={views_at_once} must be a number above 0")
    count = views.images.shape[1]
    if views_at_once is None or views_at_once >= count:
        return [views]
    return [views.select(slice(start, start + views_at_once)) for start in range(0, count, views_at_once)]
