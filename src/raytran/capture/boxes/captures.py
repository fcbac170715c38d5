# SPDX-License-Identifier: Apache-2.0
"""Captures of any format that ``predict`` reads, each with a list of boxes in it or beside it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from raytran.capture.boxes.box_list import BoxList, boxed_objects, read_box_list, read_mesh_file
from raytran.capture.boxes.categories import Categories
from raytran.capture.names import is_hidden, path_inside
from raytran.capture.open import open_scene, parse_intrinsics
from raytran.capture.orientation import WorldSettings
from raytran.capture.packed import PACKED_ENDINGS
from raytran.capture.video import VIDEO_ENDINGS
from raytran.data.prepare.boxed_mesh import Mesh
from raytran.data.prepare.boxed_objects import BoxedObjects
from raytran.data.prepare.boxed_scan import FoundSources, scene_name
from raytran.data.scan import OpenScan
from raytran.errors import ConfigError, DataError

LISTS = ("boxes.json", "scene.json")
"""Names of the list in a capture's folder, the one to prefer first."""

BESIDE = ".boxes.json"
"""Ending of the list beside a capture that is a file."""

_SCAN_MESHES = ("mesh.ply", "scan.ply", "{}_vh_clean_2.ply", "{}_mesh.ply")
"""Names of the mesh of a whole scan in its folder, if the list names none."""

_FILES = (*VIDEO_ENDINGS, *PACKED_ENDINGS, ".sens")


@dataclass(frozen=True)
class Capture:
    """A capture with its list of boxes; an ``AnnotatedSource``.

    Attributes:
        path: its folder or file.
        boxes: the list.
        categories: which classes there are.
        name: of the prepared scan; None: that of the capture.
    """

    path: Path
    boxes: Path
    categories: Categories
    name: str | None = None

    @property
    def scene_id(self) -> str:
        """Name of the prepared scan."""
        return self.name or scene_name(_stem(self.path))

    @property
    def form(self) -> str:
        """What the report calls it."""
        return "capture"

    @property
    def split(self) -> str | None:
        """The split that its list names."""
        return read_box_list(self.boxes).split

    @property
    def state(self) -> str:
        """A digest of the list and of the settings that it is read with."""
        return self.categories.state_of(self.boxes)

    def open(self) -> OpenScan:
        """Open its frames, as ``predict`` would with the settings in the list.

        Raises:
            DataError: they cannot be read, or the list is damaged.
        """
        settings = read_box_list(self.boxes).capture
        where = f"capture in {self.boxes}"
        try:
            world = WorldSettings(
                up=settings.get("up", "auto"),
                scale=settings.get("scale"),
                convention=settings.get("convention", "auto"),
                check=settings.get("check", True),
            )
            return open_scene(
                self.path,
                format=settings.get("format", "auto"),
                settings=world,
                intrinsics=parse_intrinsics(settings.get("intrinsics")),
            )
        except (ConfigError, TypeError, ValueError) as error:
            raise DataError(f"{where}: {error}") from error
        except DataError as error:
            raise DataError(f"{self.boxes.name} has no frames that can be read: {error}") from error

    def read_objects(self, scan: OpenScan) -> BoxedObjects:
        """Return the objects of the list, in the world of the open scan.

        Raises:
            DataError: the list is damaged, or says what cannot be; see ``boxed_objects``.
        """
        listed = read_box_list(self.boxes)
        return boxed_objects(
            listed,
            self.categories,
            world_from_input=scan.world_from_input,
            scan_mesh=self._scan_mesh(listed),
        )

    def _scan_mesh(self, listed: BoxList) -> Mesh | None:
        if listed.mesh is not None:
            path = path_inside(self.boxes.parent, listed.mesh, self.boxes)
            if not path.is_file():
                raise DataError(
                    f"{self.boxes} names the mesh {listed.mesh}, which is not there: mend its name"
                )
            return read_mesh_file(path)
        names = [name.format(_stem(self.path)) for name in _SCAN_MESHES]
        found = next((self.path / name for name in names if (self.path / name).is_file()), None)
        return None if found is None else read_mesh_file(found)


def find_captures(root: Path, categories: Categories, *, boxes: Path | None = None) -> FoundSources:
    """Find the captures in a folder and the list of boxes of each.

    A capture is a folder, or a video, a recording or an archive. Its list is ``boxes.json`` or
    ``scene.json`` in its folder, or ``<name>.boxes.json`` beside it, or in ``boxes`` the file ``<name>.json``
    or the folder ``<name>`` with one of these.

    Args:
        root: the folder; or one capture.
        categories: which classes there are.
        boxes: folder of lists, which are preferred to those in and beside captures; None: there is none.

    Raises:
        DataError: there is no such folder, no capture has a list, or two captures get the same name.
    """
    if not root.exists():
        raise DataError(f"there is no folder {root}: check captures=")
    if boxes is not None and not boxes.is_dir():
        raise DataError(f"there is no folder {boxes} of lists: check boxes=")
    if root.is_file() or (boxes is None and any((root / name).is_file() for name in LISTS)):
        paths = [root]
    else:
        visible = [path for path in sorted(root.iterdir()) if not is_hidden(path.name)]
        paths = [path for path in visible if path.is_dir() or path.suffix.lower() in _FILES]
    lists = {path: _list_of(path, boxes) for path in paths}
    captures = tuple(
        Capture(path, listed, categories) for path, listed in lists.items() if listed is not None
    )
    orphans = [] if root.is_file() else _orphans(root, boxes, {str(c.boxes) for c in captures})
    if not captures:
        raise _no_capture(root, len(paths), orphans)
    names = [capture.scene_id for capture in captures]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise DataError(f"two captures in {root} are called {twice}: rename one")
    return FoundSources(
        captures, tuple(path.name for path, listed in lists.items() if listed is None), tuple(orphans)
    )


def _no_capture(root: Path, count: int, orphans: list[str]) -> DataError:
    if orphans:
        return DataError(f"{orphans[0]} lies in {root} without frames: put the capture of its name beside it")
    if count:
        return DataError(
            f"none of the {count} captures in {root} has a list of boxes: write boxes.json into its folder"
        )
    return DataError(f"{root} holds no captures: give the folder that has one folder or video for each")


def _list_of(path: Path, boxes: Path | None) -> Path | None:
    """Return the list of boxes of a capture, None if it has none."""
    stem = _stem(path)
    given = [] if boxes is None else [boxes / f"{stem}.json", *(boxes / stem / name for name in LISTS)]
    own = [path / name for name in LISTS] if path.is_dir() else []
    candidates = [*given, *own, path.with_name(f"{stem}{BESIDE}")]
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def _orphans(root: Path, boxes: Path | None, used: set[str]) -> list[str]:
    """Return the names of lists that belong to no capture."""
    lists = [*root.glob(f"*{BESIDE}"), *([] if boxes is None else boxes.glob("*.json"))]
    return sorted(path.name for path in lists if str(path) not in used and not is_hidden(path.name))


def _stem(path: Path) -> str:
    return path.resolve().name if path.is_dir() else path.stem
