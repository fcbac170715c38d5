# SPDX-License-Identifier: Apache-2.0
"""A result as nodes of a viser scene: frames, boxes, meshes, names, truth, voxels, floor grid and axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
import trimesh
import viser
from matplotlib import colormaps
from numpy.typing import NDArray
from PIL import Image
from viser.transforms import SO3

from raytran.data.views import choose_even
from raytran.export.simplify import MESH_ERROR, simplify
from raytran.pictures.wireframe import box_corners, box_edges
from raytran.structs import ObjectSet
from raytran.viewer.attention import ReadPixels
from raytran.viewer.data import ViewerScene, VoxelVolume
from raytran.viewer.truth import ObjectError

FIELD_OF_VIEW = 0.87
"""Vertical, radians."""

LOOKS = {"all": (-0.55, -0.85, 1.0), "top": (0.0, -1e-3, 1.0), "front": (0.0, -1.0, 0.0)}
"""Where a camera stands that sees all of a scene, from its middle; from the top north (+y) is up."""

_FILLED = 0.9
"""Share of the picture that a scene may fill."""

_NEAREST = 0.7
"""Least distance of a camera that sees all of a scene from the scene, metres."""

Floats = NDArray[np.float64]
Pixels = NDArray[np.uint8]

_FRUSTUM_DEPTH = 0.16
_BACKDROP_DEPTH = 15.0
_AWAY = 0.02  # metres from which on a camera has left a frame's place
_MARKED = (255, 176, 0)
_FRAME = (138, 148, 163)
_NEVER_SEEN = (192, 57, 43)
_CUBE_FILL = 0.86
_DASHES = 8
_EM = 12  # height of a name's letters on the screen, pixels; viser's constant

_MAX_FACES = 300_000
_MAX_FRAMES = 32
_EXPORTED_SIDE = 320
"""Most triangles and frames of an exported scene, and the longer side of its frames in pixels."""


@dataclass(frozen=True)
class Shown:
    """What of a scene is shown.

    Attributes:
        meshes, boxes, names, frames, truth, voxels, grid: the layers.
        min_score: objects with a lower score are hidden.
        hidden_classes: labels of classes that are hidden, true objects too.
    """

    meshes: bool = True
    boxes: bool = True
    names: bool = True
    frames: bool = True
    truth: bool = True
    voxels: bool = False
    grid: bool = True
    min_score: float = 0.0
    hidden_classes: frozenset[int] = field(default_factory=frozenset)

    def objects(self, objects: ObjectSet) -> NDArray[np.bool_]:
        """Return which of ``M`` objects are shown, ``(M,)``."""
        hidden = np.isin(objects.label.numpy(), list(self.hidden_classes))
        return (objects.score.numpy() >= self.min_score) & ~hidden


class ObjectNodes(NamedTuple):
    """The nodes of one object; ``solid`` is its mesh, or its box where it has none."""

    solid: Any
    edges: Any
    front: Any
    name: Any


class SceneNodes:
    """A result in a server's scene, in place of what is there.

    Attributes:
        objects: nodes of each object.
        names, texts: class and score of each object, and what its name in the scene says.
        backdrop: frame whose picture is behind everything, or None.
        truth: dashed edges of each true object.
        frames: frusta by frame number: all, or those of an export.
        voxels: cubes of the occupied voxels of the whole volume, or None.

    Args:
        server: where to show it.
        scene: the result.
        export: for a file that is sent away: names have a size in the room and tell errors, since no program
            behind them thins them out; meshes are coarser, frames smaller and fewer.
    """

    def __init__(self, server: viser.ViserServer, scene: ViewerScene, *, export: bool = False) -> None:
        self._server, self._scene, self._export = server, scene, export
        self._shown = Shown()
        self._names: NDArray[np.bool_] | None = None
        self.backdrop: int | None = None
        self._is_there = False
        server.scene.reset()
        server.scene.set_up_direction("+z")
        # viser's own lights bleach the colours of the classes.
        server.scene.configure_default_lights(False)
        server.scene.configure_environment_map(None)
        server.scene.add_light_hemisphere("/light/sky", ground_color=(150, 150, 160), intensity=1.5)
        server.scene.add_light_directional("/light/sun", position=(2.0, -3.0, 5.0), intensity=1.5)
        corners = box_corners(scene.objects).double().numpy()
        self.name_points = corners.max(axis=1) * (0, 0, 1) + scene.objects.center.numpy() * (1, 1, 0)
        self.names = [object_name(scene, i) for i in range(len(corners))]
        self.texts = [self._text(i) for i in range(len(corners))]
        meshes = _coarser(scene.meshes) if export else scene.meshes
        self.objects = [self._add_object(i, corners[i], meshes[i]) for i in range(len(corners))]
        self.truth = self._add_truth()
        self.frames = {n: self._add_frame(n) for n in self._chosen_frames()}
        self.voxels: viser.BatchedMeshHandle | None = None
        self._add_floor()
        self.show_voxels(0.5, "probability")
        self.apply(self._shown)
        position, target = home(scene)
        server.initial_camera.position, server.initial_camera.look_at = position, target
        server.initial_camera.fov = FIELD_OF_VIEW

    def apply(self, shown: Shown, names: NDArray[np.bool_] | None = None) -> None:
        """Show and hide nodes.

        Args:
            shown: what is to be seen.
            names: ``(M,)`` whether an object's name has room on the screen; None: all have.
        """
        self._shown, self._names = shown, names
        visible = shown.objects(self._scene.objects)
        for i, nodes in enumerate(self.objects):
            has_mesh = isinstance(nodes.solid, viser.MeshHandle)
            nodes.solid.visible = bool(visible[i] and (shown.meshes if has_mesh else shown.boxes))
            nodes.edges.visible = nodes.front.visible = bool(visible[i] and shown.boxes)
            nodes.name.visible = bool(visible[i] and shown.names and (names is None or names[i]))
        if self._scene.truth is not None:
            for label, node in zip(self._scene.truth.label.tolist(), self.truth, strict=True):
                node.visible = shown.truth and label not in shown.hidden_classes
        for n, frustum in self.frames.items():
            # Pictures of cameras near by would stand in the way of a look from a frame.
            frustum.visible = shown.frames if self.backdrop is None else n == self.backdrop
        if self.voxels is not None:
            self.voxels.visible = shown.voxels
        self._grid.visible = self._server.scene.world_axes.visible = shown.grid

    def mark_object(self, index: int | None) -> None:
        """Draw the edges of one object's box black, or of none."""
        colors = self._scene.objects.classes.colors
        for i, nodes in enumerate(self.objects):
            color = (0, 0, 0) if i == index else colors[int(self._scene.objects.label[i])]
            nodes.edges.colors = nodes.front.colors = np.array(color, dtype=np.uint8)

    def mark_frame(self, index: int) -> None:
        """Draw one frame's frustum in orange."""
        for n, frustum in self.frames.items():
            frustum.color = _MARKED if n == index else _FRAME

    def set_backdrop(self, index: int | None) -> None:
        """Put a frame's picture behind everything, for a look from its camera; None: all in their place."""
        for n, frustum in self.frames.items():
            depth = _BACKDROP_DEPTH if n == index else _FRUSTUM_DEPTH
            frustum.scale = depth / frustum.compute_canonical_frustum_size()[2]
        self.backdrop, self._is_there = index, False
        self.apply(self._shown, self._names)

    def leave_backdrop(self, position: Floats) -> None:
        """Put the picture back when a camera, now at ``position`` ``(3,)``, has left the frame's place."""
        if self.backdrop is None:
            return
        away = float(np.linalg.norm(self._scene.cameras.position[self.backdrop].numpy() - position))
        if away < _AWAY:
            self._is_there = True
        elif self._is_there:  # else the message is from before the camera came
            self.set_backdrop(None)

    def show_voxels(self, threshold: float, color_by: Literal["probability", "views"]) -> None:
        """Show the voxels of at least this probability, coloured by it or by how many views saw them."""
        occupancy = self._scene.occupancy
        if occupancy is None:
            return
        volume, chosen = self._scene.volumes[0], occupancy >= threshold
        size = volume.grid.voxel_size.numpy()
        cube = trimesh.creation.box(extents=_CUBE_FILL * size)
        positions = volume.grid.voxel_centers()[chosen].numpy()
        self.voxels = self._server.scene.add_batched_meshes_simple(
            "/voxels",
            cube.vertices,
            cube.faces,
            batched_wxyzs=np.tile((1.0, 0.0, 0.0, 0.0), (len(positions), 1)),
            batched_positions=positions,
            batched_colors=voxel_colors(volume, color_by)[chosen],
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
            visible=self._shown.voxels,
        )

    def mark_voxel(self, center: Floats, size: Floats, pixels: ReadPixels | None) -> None:
        """Frame a voxel, join it with the cameras whose frames it read, and light up the cells it read.

        Args:
            center: ``(3,)`` of the voxel, metres.
            size: ``(3,)`` of the voxel, metres.
            pixels: what it read, views numbered as the scene's frames; None: not known.
        """
        self.unmark_voxel()
        cube = center + size * np.array(list(np.ndindex(2, 2, 2)), dtype=np.float64) - size / 2
        edges = box_edges()[0].numpy()
        self._server.scene.add_line_segments(
            "/voxel/cube", cube[edges], _MARKED, thickness=3.0, thickness_units="screen"
        )
        if pixels is None:
            return
        share = np.bincount(pixels.view, pixels.weight, minlength=len(self._scene.frame_ids))
        read = share.nonzero()[0]
        if len(read):
            ends = self._scene.cameras.position.numpy()[read]
            strength = (share[read] / share.max())[:, None]
            # Frames that hardly matter fade into the background.
            colors = (strength * _MARKED + (1 - strength) * 225).round().astype(np.uint8)
            self._server.scene.add_line_segments(
                "/voxel/rays",
                np.stack([np.broadcast_to(center, ends.shape), ends], axis=1),
                np.repeat(colors[:, None], 2, axis=1),
                thickness=2.0,
                thickness_units="screen",
            )
        for n, frustum in self.frames.items():
            frustum.image = draw_reads(self._scene.images[n], pixels, n)

    def unmark_voxel(self) -> None:
        """Undo ``mark_voxel``."""
        if self._server.scene.get_handle_by_name("/voxel") is not None:
            self._server.scene.remove_by_name("/voxel")
            for n, frustum in self.frames.items():
                frustum.image = self._scene.images[n]

    def _add_object(self, index: int, corners: Floats, mesh: trimesh.Trimesh | None) -> ObjectNodes:
        add, objects = self._server.scene, self._scene.objects
        label = int(objects.label[index])
        # In a file the tree of nodes is the only filter, so classes stand in it.
        path = f"/objects/{objects.classes.names[label]}/{index:02d}"
        color = objects.classes.colors[label]
        solid: Any
        if mesh is None:
            size = tuple(objects.size[index].tolist())
            turn = SO3.from_matrix(objects.rotation[index].double().numpy()).wxyz
            place = objects.center[index].numpy()
            solid = add.add_box(
                f"{path}/box", color, size, opacity=0.2, wxyz=turn, position=place, cast_shadow=False
            )
        else:
            vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
            solid = add.add_mesh_simple(
                f"{path}/mesh", vertices, faces, color=color, side="double", cast_shadow=False
            )
        edges, is_front = box_edges()
        lines, front = corners[edges.numpy()], np.array(is_front)
        return ObjectNodes(
            solid,
            add.add_line_segments(
                f"{path}/edges", lines[~front], color, thickness=2.0, thickness_units="screen"
            ),
            add.add_line_segments(
                f"{path}/front", lines[front], color, thickness=4.0, thickness_units="screen"
            ),
            self._add_name(f"{path}/name", index),
        )

    def _add_name(self, path: str, index: int) -> viser.LabelHandle:
        return self._server.scene.add_label(
            path,
            self.texts[index],
            position=self.name_points[index],
            font_size_mode="scene" if self._export else "screen",
            font_scene_height=0.09,
            anchor="bottom-center",
        )

    def _text(self, index: int) -> str:
        text, error = self.names[index], self._scene.errors[index]
        if error is None:
            return text if self._scene.truth is None else f"{text} {mark(None)}"
        return f"{text} {mark(error)}" + (f"\n{describe_error(error)}" if self._export else "")

    def _add_truth(self) -> list[viser.LineSegmentsHandle]:
        if self._scene.truth is None:
            return []
        nodes, classes = [], self._scene.truth.classes
        # Of 2n + 1 equal parts of an edge every other one is drawn.
        along = np.linspace(0, 1, 2 * _DASHES)[:, None]
        for i, corners in enumerate(box_corners(self._scene.truth).double().numpy()):
            start, stop = corners[box_edges()[0].numpy()].swapaxes(0, 1)[:, :, None]
            dashes = (start + along * (stop - start)).reshape(-1, 2, 3)
            label = int(self._scene.truth.label[i])
            name = f"/truth/{classes.names[label]}/{i:02d}"
            nodes.append(
                self._server.scene.add_line_segments(
                    name, dashes, classes.colors[label], thickness=2.0, thickness_units="screen"
                )
            )
        return nodes

    def _chosen_frames(self) -> Sequence[int]:
        count = len(self._scene.frame_ids)
        if not self._export or count <= _MAX_FRAMES:
            return range(count)
        return [int(n) for n in choose_even(count, _MAX_FRAMES)]

    def _add_frame(self, index: int) -> viser.CameraFrustumHandle:
        scene, image = self._scene, self._scene.images[index]
        height, width = scene.cameras.image_size
        camera = scene.camera(index)
        focal_x, focal_y = (float(camera.intrinsics[axis, axis]) for axis in (0, 1))
        pose = camera.world_from_camera.numpy()
        frustum = self._server.scene.add_camera_frustum(
            f"/frames/{index:04d}",
            fov=2 * np.arctan(height / 2 / focal_y),
            aspect=(width / focal_x) / (height / focal_y),
            thickness=1.5,
            thickness_units="screen",
            color=_FRAME,
            image=_smaller(image, _EXPORTED_SIDE) if self._export else image,
            format="jpeg",
            jpeg_quality=75,
            wxyz=SO3.from_matrix(pose[:3, :3]).wxyz,
            position=pose[:3, 3],
            cast_shadow=False,
        )
        frustum.scale = _FRUSTUM_DEPTH / frustum.compute_canonical_frustum_size()[2]
        return frustum

    def _add_floor(self) -> None:
        """Add lines a metre apart under everything, where the world's coordinates are whole metres."""
        points = _extremes(self._scene)
        low = np.floor(points.min(axis=0) - 0.5)
        # viser counts lines from the middle, which therefore has to be a whole number.
        size = 2 * np.ceil((points.max(axis=0) + 0.5 - low) / 2)
        self._grid = self._server.scene.add_grid(
            "/grid",
            width=float(size[0]),
            height=float(size[1]),
            cell_size=1.0,
            section_size=5.0,
            position=(*(low + size / 2)[:2], float(points[:, 2].min())),
        )
        self._server.scene.world_axes.axes_length = 0.5
        self._server.scene.world_axes.axes_radius = 0.01


def object_name(scene: ViewerScene, index: int) -> str:
    """Return an object's class and score."""
    return f"{scene.objects.category[index]} {float(scene.objects.score[index]):.2f}"


def mark(error: ObjectError | None) -> str:
    """Return the sign of an object that is found, or that is not; colours alone would not tell everybody."""
    return "✓" if error is not None and error.found else "✗"


def describe_error(error: ObjectError) -> str:
    """Return how far an object is off, in a few words."""
    return f"{100 * error.translation:.0f} cm, {error.rotation:.0f}°"


def home(scene: ViewerScene, aspect: float = 1.0, look: str = "all") -> tuple[Floats, Floats]:
    """Return a camera's position and target from which the scene fills the picture, ``(3,)`` each.

    Args:
        scene: the result.
        aspect: width of the picture over its height.
        look: one of ``LOOKS``.
    """
    points = _extremes(scene)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    back = np.array(LOOKS[look])
    back = back / np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right = right / np.linalg.norm(right)
    along = (points - middle) @ np.stack([right, np.cross(back, right), back], axis=1)
    # A point is in the picture if |x - cx| <= t (distance - z); of each axis the tightest pair decides.
    needed, center = [_NEAREST + float(along[:, 2].max())], np.zeros(2)
    for axis, tangent in enumerate(_FILLED * np.tan(FIELD_OF_VIEW / 2) * np.array([aspect, 1.0])):
        high = float((along[:, axis] + tangent * along[:, 2]).max())
        low = float((-along[:, axis] + tangent * along[:, 2]).max())
        needed.append((high + low) / (2 * tangent))
        center[axis] = (high - low) / 2
    target = middle + center[0] * right + center[1] * np.cross(back, right)
    return target + back * max(needed), target


def _extremes(scene: ViewerScene) -> Floats:
    """Return corners of all boxes and the places of all cameras, ``(n, 3)``, at least two."""
    sets = [scene.objects] if scene.truth is None else [scene.objects, scene.truth]
    points = [box_corners(objects).double().numpy().reshape(-1, 3) for objects in sets]
    points.append(scene.cameras.position.double().numpy())
    joined = np.concatenate(points)
    return joined if len(joined) > 1 else np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]])


def voxel_colors(volume: VoxelVolume, color_by: Literal["probability", "views"]) -> Pixels:
    """Return the colour of each voxel, ``(X, Y, Z, 3)``: ``viridis`` from 0 to 1, or to the most views.

    By views, those that no view saw are red.
    """
    if color_by == "views" and volume.view_count is not None:
        count = volume.view_count.numpy()
        colors = colormaps["viridis"](count / max(count.max(), 1), bytes=True)[..., :3]
        colors[count == 0] = _NEVER_SEEN
        return np.asarray(colors)
    occupancy = np.zeros(volume.grid.resolution) if volume.occupancy is None else volume.occupancy.numpy()
    return np.asarray(colormaps["viridis"](occupancy, bytes=True)[..., :3])


def draw_reads(image: Pixels, pixels: ReadPixels, frame: int) -> Pixels:
    """Return a picture that is dark but for the cells that were read, which are orange by their weight.

    Args:
        image: ``(rows, columns, 3)``.
        pixels: what a voxel read.
        frame: which of its views the picture is.
    """
    height, width = pixels.feature_size
    here = pixels.view == frame
    share = np.full(pixels.feature_size, -1.0)
    strongest = max(pixels.weight.max(initial=0), 1e-9)
    share[pixels.row[here], pixels.column[here]] = pixels.weight[here] / strongest
    rows = np.arange(image.shape[0]) * height // image.shape[0]
    columns = np.arange(image.shape[1]) * width // image.shape[1]
    share = share[rows[:, None], columns][..., None]
    opacity = 0.15 + 0.75 * share
    lit = image * (1 - opacity) + np.array(_MARKED) * opacity
    return np.where(share >= 0, lit, 0.45 * image).round().astype(np.uint8)


def names_with_room(
    points: Floats,
    names: Sequence[str],
    camera: viser.CameraHandle,
    wanted: NDArray[np.bool_],
    first: int | None = None,
) -> NDArray[np.bool_]:
    """Return which names are shown so that none covers a surer object's, ``(M,)``.

    Args:
        points: ``(M, 3)`` middle of each name's lower edge in the world.
        names: of the objects, surest first.
        camera: of a browser.
        wanted: ``(M,)`` names that there are; the others take no room.
        first: number of the object whose name is shown before all others, or None.
    """
    height, width = camera.image_height, camera.image_width
    in_camera = (points - camera.position) @ SO3(camera.wxyz).as_matrix()
    focal = height / 2 / np.tan(camera.fov / 2)
    ahead = in_camera[:, 2] > 1e-3
    depth = np.where(ahead, in_camera[:, 2], 1.0)[:, None]
    middle = in_camera[:, :2] / depth * focal + (width / 2, height / 2)
    half = np.array([[0.33 * _EM * len(name), 0.8 * _EM] for name in names]).reshape(-1, 2)
    shown = np.zeros(len(names), dtype=bool)
    in_turn = sorted(np.flatnonzero(wanted & ahead).tolist(), key=lambda i: i != first)
    for i in in_turn:
        apart = np.abs(middle[i] - middle[shown]) > half[i] + half[shown]
        shown[i] = bool(apart.any(axis=1).all())
    return shown


def in_plain_sight(points: Floats, eye: Floats, objects: ObjectSet) -> NDArray[np.bool_]:
    """Return which points no box of another object hides, ``(M,)``; a box hides nothing inside of it.

    Args:
        points: ``(M, 3)``, one above each object.
        eye: ``(3,)`` place of the camera.
        objects: the ``M`` objects.
    """
    turn, half = objects.rotation.double().numpy(), objects.size.double().numpy() / 2
    center = objects.center.double().numpy()
    # Boxes in rows, points in columns, along the axes of each box.
    start = np.einsum("bij,bi->bj", turn, eye - center)[:, None]
    stop = np.einsum("bij,bpi->bpj", turn, points - center[:, None])
    way = stop - start
    way = np.where(np.abs(way) < 1e-9, 1e-9, way)
    enter, leave = np.sort([(-half[:, None] - start) / way, (half[:, None] - start) / way], axis=0)
    enter, leave = enter.max(axis=2, initial=-np.inf), leave.min(axis=2, initial=np.inf)
    hides = (enter < leave) & (enter > 0) & (leave < 1)
    np.fill_diagonal(hides, False)
    return np.asarray(~hides.any(axis=0))


def _smaller(image: Pixels, side: int) -> Pixels:
    picture = Image.fromarray(image)
    picture.thumbnail((side, side))
    return np.asarray(picture)


def _coarser(meshes: Sequence[trimesh.Trimesh | None]) -> list[trimesh.Trimesh | None]:
    """Return meshes of ever larger error until all together are small enough."""
    result, error = list(meshes), MESH_ERROR
    while sum(len(mesh.faces) for mesh in result if mesh is not None) > _MAX_FACES:
        result = [None if mesh is None else simplify(mesh, error) for mesh in result]
        error *= 2
    return result
