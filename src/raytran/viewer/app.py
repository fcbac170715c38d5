# SPDX-License-Identifier: Apache-2.0
"""The panel beside a scene: what is switched on, and what happens on a click."""

from __future__ import annotations

import math
import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import viser
from matplotlib import colormaps
from PIL import Image, ImageDraw
from viser.transforms import SO3

from raytran.errors import DataError
from raytran.geometry.camera import Cameras
from raytran.pictures.wireframe import box_segments
from raytran.structs import ObjectSet
from raytran.viewer.attention import ReadPixels
from raytran.viewer.data import ViewerScene, read_viewer_scene
from raytran.viewer.scene import (
    FIELD_OF_VIEW,
    LOOKS,
    Floats,
    Pixels,
    SceneNodes,
    Shown,
    draw_reads,
    home,
    in_plain_sight,
    mark,
    names_with_room,
)

_REACH = 30.0
"""Metres along a click's ray in which something is looked for."""

_PANEL_WIDTH = 480
"""Pixels to which small frames are enlarged, about."""

_LAYERS = ("meshes", "boxes", "names", "frames", "truth", "voxels", "grid")
_KEYS = {"all": ("F", "fit all of the scene"), "top": ("T", "from the top"), "front": ("N", "look north")}
"""Key and meaning of each of ``LOOKS``."""

_COLORINGS: dict[str, Literal["probability", "views"]] = {
    "how likely it is occupied": "probability",
    "how many views saw it": "views",
}
_HOW_TO_READ = (
    "Shift-click anywhere, or press the button and then tap: the pixels light up from which the network's "
    "last block gathered the features of the first voxel or mesh there. With voxels shown, click or tap one."
)


class ViewerApp:
    """The panel beside a scene; every browser that looks shares it.

    Attributes:
        scene: the result shown.
        nodes: its nodes.
        shown: what of it is to be seen.
        object, frame: number of the chosen object, or None, and of the chosen frame.
        pixels: what the chosen voxel read, or None.

    Args:
        server: where to show it.
        scenes: folder of each result by the name to call it (``find_scenes``).

    Raises:
        DataError: the first result is damaged.
    """

    def __init__(self, server: viser.ViserServer, scenes: Mapping[str, Path]) -> None:
        self.server, self.scenes = server, scenes
        # Callbacks come from many threads; one at a time changes the scene.
        self._lock = threading.RLock()
        self._camera: viser.CameraHandle | None = None
        self.pixels: ReadPixels | None = None
        self.object: int | None = None
        server.gui.configure_theme(show_share_button=False, show_logo=False, control_width="large")
        self.open(next(iter(scenes)))

        @server.on_client_connect
        def _(client: viser.ClientHandle) -> None:
            client.camera.on_update(self.move)
            self.move(client.camera)
            self._look(client)

    def open(self, name: str) -> None:
        """Show another result.

        Raises:
            DataError: it is damaged.
        """
        scene = read_viewer_scene(self.scenes[name])
        with self._lock, self.server.atomic():
            self.scene, self.shown, self.pixels, self.object = scene, Shown(), None, None
            self.frame = 0
            self.nodes = SceneNodes(self.server, scene)
            self.server.gui.reset()
            self._add_panel(name)
            self._listen()
            self.update()
            self.select_object(None)
            if scene.images:
                self.select_frame(0)
            for client in self.server.get_clients().values():
                self._look(client)

    def update(self, _event: object = None) -> None:
        """Show what the panel says."""
        with self._lock, self.server.atomic():
            self.shown = Shown(
                **{name: box.value for name, box in self.layers.items()},
                min_score=self.score.value,
                hidden_classes=frozenset(label for label, box in self.classes.items() if not box.value),
            )
            self._apply()
            if self.voxel_panel is not None:
                self.voxel_panel.visible = self.shown.voxels
            self.table.content = object_table(self.scene, self.shown)
            self._draw_frame()

    def move(self, camera: viser.CameraHandle) -> None:
        """Leave out the names that would cover others, seen from a browser's camera."""
        with self._lock, self.server.atomic():
            self._camera = camera
            self.nodes.leave_backdrop(camera.position)
            self._apply()

    def select_object(self, index: int | None, _event: object = None) -> None:
        """Choose an object; None or -1: none."""
        with self._lock, self.server.atomic():
            self.object = None if index is None or index < 0 else index
            self.nodes.mark_object(self.object)
            self._apply()
            chosen = 0 if self.object is None else self.object + 1
            self.choice.value = self.choice.options[chosen]  # type: ignore[misc]
            self.details.content = describe_object(self.scene, self.object)

    def select_frame(self, index: int, _event: object = None) -> None:
        """Choose a frame for the panel."""
        with self._lock, self.server.atomic():
            self.frame = index
            self.nodes.mark_frame(index)
            if self.nodes.backdrop not in (None, index):
                for client in self.server.get_clients().values():
                    self._look_from_frame(client)
            if self.frame_slider is not None and self.frame_slider.value != index:
                self.frame_slider.value = index  # type: ignore[misc]
            self._draw_frame()

    def select_voxel(self, point: Floats | None) -> None:
        """Choose the voxel at a point ``(3,)`` in the world, and the frame it read most; None: none."""
        with self._lock, self.server.atomic():
            volume = None if point is None else self.scene.volume_at(point)
            voxel = None if volume is None or point is None else volume.voxel_at(point)
            if volume is None or voxel is None:
                self.pixels = None
                self.nodes.unmark_voxel()
                self.reads.content = _HOW_TO_READ
            else:
                self.pixels = volume.pixels_of(voxel)
                size = volume.grid.voxel_size.numpy()
                center = volume.grid.lower.numpy() + (np.array(voxel) + 0.5) * size
                self.nodes.mark_voxel(center, size, self.pixels)
                self.reads.content = describe_reads(voxel, self.pixels, self.scene.frame_ids)
            # Who looks from a frame stays there, and the panel with the camera.
            if self.pixels is not None and len(self.pixels.view) and self.nodes.backdrop is None:
                self.select_frame(int(np.bincount(self.pixels.view, self.pixels.weight).argmax()))
            else:
                self._draw_frame()

    def select_voxel_along(self, origin: Floats, direction: Floats) -> None:
        """Choose the first voxel along a ray that is occupied or holds a mesh that is shown."""
        self.select_voxel(first_hit(self.scene, self.shown, self.threshold, origin, direction))

    @property
    def threshold(self) -> float:
        """Probability from which on voxels are shown."""
        return 0.5 if self.occupancy is None else float(self.occupancy.value)

    def _apply(self) -> None:
        names = None
        if self._camera is not None:
            wanted = self.shown.objects(self.scene.objects)
            points = self.nodes.name_points
            if self.shown.meshes and wanted.any():
                chosen = np.flatnonzero(wanted)
                objects = self.scene.objects.select(torch.from_numpy(wanted))
                wanted = wanted.copy()
                wanted[chosen] = in_plain_sight(points[chosen], self._camera.position, objects)
                if self.object in chosen:
                    wanted[self.object] = True
            names = names_with_room(points, self.nodes.texts, self._camera, wanted, self.object)
        self.nodes.apply(self.shown, names)

    def _draw_frame(self) -> None:
        if self.picture is None:
            return
        image = self.scene.images[self.frame]
        if self.pixels is not None:
            image = draw_reads(image, self.pixels, self.frame)
        chosen = self.scene.objects.select(torch.from_numpy(self.shown.objects(self.scene.objects)))
        self.picture.image = draw_boxes(image, self.scene.camera(self.frame), chosen)
        self.picture.label = (
            f"{self.scene.frame_ids[self.frame]}, {self.frame + 1} of {len(self.scene.images)}"
        )

    def _add_panel(self, name: str) -> None:
        """Add the panel's parts for the scene that is open."""
        gui, scene = self.server.gui, self.scene
        gui.main_panel.dock_right()
        has_voxels = self.nodes.voxels is not None
        there = {"frames": bool(scene.images), "truth": scene.truth is not None, "voxels": has_voxels}
        if len(self.scenes) > 1:
            choice = gui.add_dropdown("scene", tuple(self.scenes), initial_value=name)
            choice.on_update(self._open_chosen)
        self._add_looks()
        with gui.add_folder("Show"):
            self.layers = {
                layer: gui.add_checkbox(layer, getattr(Shown(), layer), visible=there.get(layer, True))
                for layer in _LAYERS
            }
            lowest = float(scene.objects.score.min()) if len(scene.objects) else 0.0
            lowest = min(float(np.floor(100 * lowest) / 100), 0.99)
            self.score = gui.add_slider("score ≥", lowest, 1.0, 0.01, lowest)
        self.occupancy: viser.GuiSliderHandle[float] | None = None
        self.voxel_panel: viser.GuiFolderHandle | None = None
        if has_voxels:
            self.voxel_panel = gui.add_folder("Voxels", visible=False)
            with self.voxel_panel:
                self._add_voxel_panel()
        labels = [scene.objects.label] if scene.truth is None else [scene.objects.label, scene.truth.label]
        with gui.add_folder("Classes", expand_by_default=False):
            self.classes = {
                label: gui.add_checkbox(scene.objects.classes.names[label], True)
                for label in sorted(set(torch.cat(labels).tolist()))
            }
        self.frame_slider: viser.GuiSliderHandle[int] | None = None
        self.picture: viser.GuiImageHandle | None = None
        with gui.add_folder("Frame", visible=bool(scene.images)):
            if scene.images:
                self._add_frame_panel()
            has_reads = any(v.reads for v in scene.volumes)
            pick = gui.add_button("choose what to read by the next click or tap", visible=has_reads)
            pick.on_click(self._pick)
            self.reads = gui.add_markdown(_HOW_TO_READ, visible=has_reads)
        with gui.add_folder("Objects"):
            options = ("none", *(f"{i:02d} {name}" for i, name in enumerate(self.nodes.names)))
            self.choice = gui.add_dropdown("details of", options)
            self.choice.on_update(lambda event: self.select_object(options.index(event.target.value) - 1))
            self.details = gui.add_markdown("")
            self.table = gui.add_markdown("")
        controls: list[Any] = [*self.layers.values(), *self.classes.values(), self.score]
        for control in controls:
            control.on_update(self.update)

    def _open_chosen(self, event: viser.GuiEvent[viser.GuiDropdownHandle[str]]) -> None:
        try:
            self.open(event.target.value)
        except DataError as error:
            if event.client is not None:
                event.client.add_notification(f"cannot show {event.target.value}", str(error), color="red")

    def _add_voxel_panel(self) -> None:
        gui = self.server.gui
        self.occupancy = gui.add_slider("occupied ≥", 0.02, 1.0, 0.01, 0.5)
        coloring = gui.add_dropdown("coloured by", tuple(_COLORINGS))
        legend = gui.add_image(color_scale(), label=self._scale_label("probability"))

        def show(_: object) -> None:
            with self._lock, self.server.atomic():
                by = _COLORINGS[coloring.value]
                legend.label = self._scale_label(by)
                self.nodes.show_voxels(self.threshold, by)
                self._listen_to_voxels()

        self.occupancy.on_update(show)
        coloring.on_update(show)

    def _scale_label(self, color_by: Literal["probability", "views"]) -> str:
        count = self.scene.volumes[0].view_count
        if color_by == "probability" or count is None:
            return "probability 0 to 1"
        return f"views 0 to {int(count.max())}; red: none"

    def _add_frame_panel(self) -> None:
        gui, count = self.server.gui, len(self.scene.images)
        if count > 1:
            self.frame_slider = gui.add_slider("number", 0, count - 1, 1, 0)
            self.frame_slider.on_update(lambda event: self.select_frame(int(event.target.value)))
        self.picture = gui.add_image(self.scene.images[0], format="jpeg")
        button = gui.add_button("look from here")

        @button.on_click
        def _(event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
            if event.client is not None:
                self._look_from_frame(event.client)

    def _key_pressed(self, look: str, event: viser.CommandEvent) -> None:
        self._look(event.client, look)

    def _add_looks(self) -> None:
        """Add buttons and keys that bring all of the scene into the picture."""
        buttons = self.server.gui.add_button_group("look (F, T, N)", tuple(LOOKS))
        buttons.on_click(lambda event: self._look(event.client, event.target.value))
        for look, (key, meaning) in _KEYS.items():
            command = self.server.gui.add_command(meaning, hotkey=key)  # type: ignore[arg-type]
            command.on_trigger(partial(self._key_pressed, look))

    def _listen(self) -> None:
        """Have clicks on objects, frames and voxels choose them."""
        for i, nodes in enumerate(self.nodes.objects):
            nodes.solid.on_click(partial(self.select_object, i))
        for n, frustum in self.nodes.frames.items():
            frustum.on_click(partial(self.select_frame, n))
        self._listen_to_voxels()
        self.server.scene.remove_click_callback()
        self.server.scene.on_click(modifier="shift")(self._clicked)

    def _listen_to_voxels(self) -> None:
        if self.nodes.voxels is not None:
            self.nodes.voxels.on_click(self._clicked)

    def _clicked(self, event: viser.SceneClickEvent | viser.SceneNodePointerEvent[Any]) -> None:
        self.select_voxel_along(np.array(event.ray_origin), np.array(event.ray_direction))

    def _pick(self, _event: object) -> None:
        """Have the next click anywhere choose what to read; a finger has no shift key."""

        def picked(event: viser.SceneClickEvent) -> None:
            self.server.scene.remove_click_callback(picked)
            self._clicked(event)

        self.server.scene.on_click()(picked)

    def _look(self, client: viser.ClientHandle | None, look: str = "all") -> None:
        """Have a browser's camera see all of the scene, from one of ``LOOKS``."""
        if client is None:
            return
        # The panel takes some of a wide window after the first message.
        position, target = home(self.scene, min(client.camera.aspect, 1.0), look)
        with client.atomic():
            client.camera.up_direction = (0.0, 0.0, 1.0)
            client.camera.position = position
            client.camera.look_at = target
            client.camera.fov = FIELD_OF_VIEW

    def _look_from_frame(self, client: viser.ClientHandle) -> None:
        """Lay the objects over a frame: its picture goes behind everything until one moves away."""
        camera = self.scene.camera(self.frame)
        with client.atomic():
            client.camera.position = camera.position.numpy()
            client.camera.wxyz = SO3.from_matrix(camera.world_from_camera[:3, :3].numpy()).wxyz
            client.camera.fov = 2 * math.atan(camera.image_size[0] / 2 / float(camera.intrinsics[1, 1]))
        self.nodes.set_backdrop(self.frame)


def first_hit(
    scene: ViewerScene, shown: Shown, threshold: float, origin: Floats, direction: Floats
) -> Floats | None:
    """Return where a ray first meets a mesh that is shown or a voxel that is occupied, ``(3,)``, or None.

    Args:
        scene: the result.
        shown: what of it is shown.
        threshold: probability from which on a voxel counts as occupied, whether voxels are shown or not.
        origin: ``(3,)`` metres.
        direction: ``(3,)`` of any length.
    """
    direction = direction / np.linalg.norm(direction)
    points = []
    for visible, mesh in zip(shown.objects(scene.objects), scene.meshes, strict=True):
        if visible and mesh is not None:
            hits, _, _ = mesh.ray.intersects_location([origin], [direction])
            # A little inside, where the voxel is that the surface belongs to.
            points += [hit + 1e-3 * direction for hit in hits]
    if scene.occupancy is not None:
        volume = scene.volumes[0]
        step = float(volume.grid.voxel_size.min()) / 3
        along = torch.from_numpy(origin + np.arange(0, _REACH, step)[:, None] * direction)
        index = volume.grid.voxel_from_world(along).floor().long()
        inside = ((index >= 0) & (index < torch.tensor(volume.grid.resolution))).all(dim=1)
        occupied = scene.occupancy.flatten()[volume.grid.flat_index(index * inside[:, None])] >= threshold
        points += list(along[inside & occupied][:1].numpy())
    return min(points, key=lambda point: float(np.linalg.norm(point - origin)), default=None)


def draw_boxes(image: Pixels, camera: Cameras, objects: ObjectSet) -> Pixels:
    """Return a camera's picture, large enough to look at, with boxes over it, those of the front bold."""
    picture = Image.fromarray(image)
    enlarged = max(1, round(_PANEL_WIDTH / picture.width))
    picture = picture.resize((picture.width * enlarged, picture.height * enlarged), Image.Resampling.NEAREST)
    pen = ImageDraw.Draw(picture)
    scaled = camera.scaled_to((picture.height, picture.width))
    for label, segments in zip(objects.label.tolist(), box_segments(objects, scaled), strict=True):
        for *line, is_front in segments:
            pen.line(line, fill=objects.classes.colors[label], width=3 if is_front else 1)
    return np.asarray(picture)


def color_scale() -> Pixels:
    """Return the colours of voxels from least to most, ``(12, 256, 3)``."""
    colors = colormaps["viridis"](np.linspace(0, 1, 256), bytes=True)[:, :3]
    return np.tile(colors, (12, 1, 1))


def object_table(scene: ViewerScene, shown: Shown) -> str:
    """Return the objects that are shown with their errors, as Markdown."""
    visible = np.flatnonzero(shown.objects(scene.objects)).tolist()
    lines = [f"**{len(visible)} of {len(scene.objects)}** objects"]
    if scene.truth is not None:
        lines[0] += f", {describe_found(scene, visible)}"
    with_errors = scene.truth is not None
    lines += ["", "| object | score |" + (" cm | ° | size | IoU |" if with_errors else "")]
    lines += ["|---|--:|" + "--:|" * (4 if with_errors else 0)]
    for i in visible:
        name, score = scene.objects.category[i], float(scene.objects.score[i])
        error = scene.errors[i]
        sign = f" {mark(error)}" if with_errors else ""
        line = f"| {i:02d} {name}{sign} | {score:.2f} |"
        if error is not None:
            line += f" {100 * error.translation:.1f} | {error.rotation:.0f} "
            line += f"| {error.scale:.0%} | {error.iou:.2f} |"
        elif with_errors:
            line += " – | – | – | – |"
        lines.append(line)
    return "\n".join(lines)


def describe_found(scene: ViewerScene, visible: Sequence[int]) -> str:
    """Return how many true objects the visible ones found, and the classes of those they missed."""
    truth = () if scene.truth is None else scene.truth.category
    errors = [scene.errors[i] for i in visible]
    found = {error.truth for error in errors if error is not None and error.found}
    missed = Counter(name for i, name in enumerate(truth) if i not in found)
    text = f"**{len(found)} of {len(truth)}** true ones found"
    return f"{text}; missed: {', '.join(f'{n} {name}' for name, n in missed.items())}" if missed else text


def describe_object(scene: ViewerScene, index: int | None) -> str:
    """Return an object's size, place, CAD model and true object."""
    if index is None:
        return ""
    objects, error = scene.objects, scene.errors[index]
    size = " × ".join(f"{value:.2f}" for value in objects.size[index].tolist())
    center = ", ".join(f"{value:.2f}" for value in objects.center[index].tolist())
    text = f"{size} m (width × height × depth) at ({center})"
    if objects.model_id and objects.model_id[index]:
        text += f", CAD {objects.model_id[index]}"
    if scene.truth is None:
        return f"{text}."
    if error is None:
        return f"{text}. There is no true object of its class."
    found = "Found" if error.found else "Nearest of its class, but beyond the limits or found by a surer one"
    return f"{text}. {found}: true object {error.truth}."


def describe_reads(voxel: tuple[int, int, int], pixels: ReadPixels | None, frame_ids: Sequence[str]) -> str:
    """Return how many pixels a voxel read, and from which frames most."""
    if pixels is None:
        return f"voxel {voxel}: what it read is not known."
    share = np.bincount(pixels.view, pixels.weight, minlength=len(frame_ids))
    most = [f"{frame_ids[n]} {share[n]:.0%}" for n in np.argsort(-share)[:3] if share[n] > 0]
    if not most:
        return f"voxel {voxel}: no ray passes through it."
    frames = int((share > 0).sum())
    pixel = "1 pixel" if len(pixels.view) == 1 else f"{len(pixels.view)} pixels"
    if frames == 1:
        return f"voxel {voxel} read {pixel} of one frame, {most[0].rsplit(' ', 1)[0]}."
    return f"voxel {voxel} read {pixel} of {frames} frames, most from {', '.join(most)}."
