# SPDX-License-Identifier: Apache-2.0
"""What stands in which kind of room: desks with displays and chairs, sofas with coffee tables, beds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from raytran.classes import PAPER_CLASSES
from raytran.rooms.cad import CadModel
from raytran.rooms.layout import Layout
from raytran.rooms.library import ModelPool

ROOM_KINDS = {
    "office": 0.26,
    "living": 0.2,
    "bedroom": 0.18,
    "dining": 0.12,
    "meeting": 0.12,
    "bathroom": 0.12,
}
"""What a room can be used for, and how often."""

_DINING = ("dining table",)
_DESKS = ("desk",)
_DESK_CHAIRS = ("office chair", "armed chair", "dining chair")
_TABLE_CHAIRS = ("dining chair", "armed chair", "stool", "office chair")

_EXTRAS: dict[str, dict[str, float]] = {
    "office": {"bookshelf": 3, "cabinet": 3, "trashbin": 3, "chair": 2, "printer": 2, "lamp": 1, "sofa": 1},
    "living": {"bookshelf": 3, "cabinet": 2, "trashbin": 1, "chair": 2, "lamp": 3, "sofa": 2, "pillow": 2},
    "bedroom": {"bookshelf": 2, "cabinet": 3, "trashbin": 1, "chair": 1, "lamp": 3, "pillow": 2},
    "dining": {"bookshelf": 1, "cabinet": 4, "trashbin": 3, "chair": 1, "lamp": 1},
    "meeting": {"bookshelf": 3, "cabinet": 2, "trashbin": 2, "chair": 3, "printer": 1},
    "bathroom": {"cabinet": 3, "trashbin": 2, "chair": 2, "lamp": 1},
}
_OTHERS = {
    "printer": ("printer", "copier"),
    "lamp": ("floor lamp", "table lamp"),
    "pillow": ("pillow",),
}
_GIVEN: dict[str, dict[str, float]] = {
    "office": {"file cabinet": 2, "flowerpot": 2, "laptop": 1, "bench": 0.5},
    "living": {"piano": 1, "flowerpot": 2, "speaker": 1, "basket": 0.5},
    "bedroom": {"crib": 0.5, "bunk bed": 0.5, "flowerpot": 1, "basket": 1, "laptop": 0.5},
    "dining": {"stove": 1, "microwave": 1, "bench": 1, "flowerpot": 2},
    "meeting": {"flowerpot": 2, "laptop": 2, "speaker": 1},
    "bathroom": {"washing machine": 2, "basket": 2, "flowerpot": 1},
}
"""Kinds in the class ``other`` that are placed only if given CAD models have them."""

_MOST = {"trashbin": 2, "lamp": 3, "sofa": 2, "printer": 2, "pillow": 4}


@dataclass
class Furnisher:
    """Fills a layout up to a number of objects.

    Attributes:
        layout: the room being furnished.
        pool: where the models come from.
        wanted: objects to place at most.
        tucked: share of the chairs at tables that are pushed under them.
    """

    layout: Layout
    pool: ModelPool
    wanted: int
    tucked: float = 0.0

    @property
    def room_left(self) -> int:
        """How many objects may still be placed."""
        return self.wanted - len(self.layout.objects)

    def furnish(self) -> None:
        """Place the groups that make the room what it is, then single pieces until the number is reached."""
        _GROUPS[self.layout.room.kind](self)
        self.fill_up(_EXTRAS[self.layout.room.kind])

    def fill_up(self, usual: dict[str, float], *, given_share: float = 1.0) -> None:
        """Place single pieces until the number is reached.

        Args:
            usual: weight of each piece.
            given_share: factor of the weights of kinds that only given CAD models have.
        """
        kinds = _GIVEN[self.layout.room.kind]
        given = {kind: given_share * share for kind, share in kinds.items() if self.pool.has(kind)}
        weights = usual | given
        names, share = list(weights), np.array(list(weights.values())) / sum(weights.values())
        for _ in range(4 * self.wanted):
            if self.room_left <= 0:
                return
            self.extra(str(self.layout.rng.choice(names, p=share)))

    def extra(self, name: str) -> None:
        """Place one more piece; nothing happens if it finds no place."""
        rng, layout = self.layout.rng, self.layout
        kinds = _OTHERS.get(name, () if name in PAPER_CLASSES.names else (name,))
        present = [o for o in layout.objects if o.model.category == name or o.model.kind in kinds]
        if len(present) >= _MOST.get(name, self.wanted if name in PAPER_CLASSES.names else 2):
            return
        model = self.draw("other", *kinds) if kinds else self.draw(name)
        if model is None:
            return
        if model.support in ("table", "bed"):
            self.on_something(model)
        elif model.support == "floor" and name in ("chair", "table") and rng.random() < 0.6:
            layout.anywhere(model)
        else:
            layout.at_wall(model)

    def on_something(self, model: CadModel) -> int | None:
        """Place a model on any table or low cabinet (``support`` "table") or bed or sofa ("bed")."""
        fitting = ("table", "cabinet") if model.support == "table" else ("bed", "sofa")
        bases = [
            i
            for i, o in enumerate(self.layout.objects)
            if o.model.category in fitting or o.model.kind in fitting
        ]
        for base in self.layout.rng.permutation(np.array(bases, dtype=int)):
            placed = self.layout.on_top(int(base), model)
            if placed is not None:
                return placed
        return None

    def draw(self, category: str, *kinds: str) -> CadModel | None:
        """Draw a model, or None if no more objects are wanted."""
        return self.pool.draw(category, self.layout.rng, kinds=kinds) if self.room_left > 0 else None

    def desk(self) -> None:
        """A desk at a wall or in the room, displays facing the user, a chair, perhaps a lamp or printer."""
        rng, layout = self.layout.rng, self.layout
        model = self.draw("table", *_DESKS)
        if model is None:
            return
        desk = layout.at_wall(model) if rng.random() < 0.75 else layout.anywhere(model)
        if desk is None:
            return
        screen = self.draw("display", "monitor")
        shifts = (0.0,) if screen is None or rng.random() < 0.6 else (-0.6, 0.6)
        for shift in shifts:
            if screen is not None and self.room_left > 0:
                layout.on_top(
                    desk, screen, place=(shift, rng.uniform(0.2, 0.6)), turn=rng.normal(0, 0.1) - 0.3 * shift
                )
        self.chair_at(desk, self.draw("chair", *_DESK_CHAIRS), 0.0)
        thing = self.draw("other", *(("table lamp",) if rng.random() < 0.5 else ("printer",)))
        if thing is not None and rng.random() < 0.4 and thing.support == "table":
            layout.on_top(desk, thing)
        bin_model = self.draw("trashbin")
        if bin_model is not None and rng.random() < 0.4:
            side = layout.objects[desk].rotation[:2, 0] * rng.choice([-1.0, 1.0])
            layout.beside(desk, bin_model, side / np.linalg.norm(side), along=0.0, facing="same")

    def chair_at(self, table: int, model: CadModel | None, along: float) -> None:
        """Put a chair at the front of a table, looking at it."""
        if model is not None:
            front = -self.layout.objects[table].rotation[:2, 2]
            self.seat_at(table, model, front / np.linalg.norm(front), along)

    def seat_at(self, table: int, model: CadModel, direction: NDArray[np.float64], along: float) -> None:
        """Put a chair at a side of a table, looking at it, some of them pushed under."""
        depth = 0.0
        if self.tucked and self.layout.rng.random() < self.tucked:
            depth = float(self.layout.rng.uniform(0.2, 0.65)) * float(self.layout.size_of(model)[2])
        self.layout.beside(table, model, direction, along=along, facing="anchor", tucked=depth)

    def table_with_chairs(self, *, most: int) -> None:
        """A table in the middle of the room with chairs on its sides, most often all alike."""
        rng, layout = self.layout.rng, self.layout
        model = self.draw("table", *_DINING)
        if model is None:
            return
        middle = np.array(layout.room.size[:2]) / 2
        table = None
        for attempt in range(20):
            if attempt == 10:
                model = self.draw("table", *_DINING) or model
            turn = rng.integers(4) * np.pi / 2 + rng.normal(0, 0.05)
            table = layout.on_floor(model, middle + rng.normal(0, 0.5, size=2), turn)
            if table is not None:
                break
        if table is None:
            return
        self.seats_round(table, most=most)

    def seats_round(self, table: int, *, most: int) -> None:
        """Put chairs on the sides of a table, most often all alike."""
        rng = self.layout.rng
        chair = self.draw("chair", *_TABLE_CHAIRS)
        alike = rng.random() < 0.75
        for direction, along in self._seats(table)[:most]:
            if rng.random() < 0.15:
                continue
            seat = chair if alike else self.draw("chair", *_TABLE_CHAIRS)
            if seat is not None and self.room_left > 0:
                self.seat_at(table, seat, direction, along)

    def _seats(self, table: int) -> list[tuple[np.ndarray, float]]:
        """Return places round a table as (outward direction, shift along the side), in random order."""
        placed = self.layout.objects[table]
        half = placed.box.half[0]
        seats = []
        for axis, across in ((0, 2), (2, 0)):
            outward = placed.rotation[:2, axis] / np.linalg.norm(placed.rotation[:2, axis])
            count = max(1, int(2 * half[across] / 0.68))
            shifts = (np.arange(count) + 0.5) / count * 2 * half[across] - half[across]
            seats += [(sign * outward, float(shift)) for sign in (-1.0, 1.0) for shift in shifts]
        return [seats[i] for i in self.layout.rng.permutation(len(seats))]

    def sofa_corner(self) -> None:
        """A sofa at a wall with a coffee table before it, pillows on it, and a television opposite."""
        rng, layout = self.layout.rng, self.layout
        model = self.draw("sofa")
        sofa = None if model is None else layout.at_wall(model)
        if sofa is None:
            return
        low = self.draw("table", "coffee table")
        if low is not None:
            front = -layout.objects[sofa].rotation[:2, 2]
            front = front / np.linalg.norm(front)
            reach = layout.objects[sofa].box.half[0, 2] + layout.size_of(low)[2] / 2 + rng.uniform(0.3, 0.5)
            spot = layout.objects[sofa].box.center[0, :2] + front * reach
            layout.on_floor(low, spot, float(np.arctan2(-front[0], front[1])) + rng.normal(0, 0.05))
        for _ in range(int(rng.integers(0, 4))):
            pillow = self.draw("other", "pillow")
            if pillow is not None:
                layout.on_top(sofa, pillow)
        self.television()

    def television(self) -> None:
        """A cabinet or low table at a wall with a display on it that looks into the room."""
        for _ in range(3):
            base_model = self.draw("cabinet", "tv cabinet", "sideboard")
            screen = self.draw("display", "television", "tube television")
            if base_model is None or screen is None or self.room_left < 2:
                return
            base = self.layout.at_wall(base_model)
            if base is not None:
                self.layout.on_top(base, screen, place=(0.0, 0.0))
                return

    def bed(self) -> None:
        """A bed with its head to a wall, pillows on it and a cabinet beside it."""
        rng, layout = self.layout.rng, self.layout
        model = self.draw("other", "bed")
        bed = None if model is None else layout.at_wall(model)
        if bed is None:
            return
        for shift in (-0.5, 0.5) if rng.random() < 0.6 else (0.0,):
            pillow = self.draw("other", "pillow")
            if pillow is not None:
                for back in (0.8, 0.65, 0.5):
                    if layout.on_top(bed, pillow, place=(shift, back), turn=rng.normal(0, 0.1)) is not None:
                        break
        for model in (self.draw("cabinet", "night stand"), self.draw("other", "floor lamp")):
            if model is not None:
                side = layout.objects[bed].rotation[:2, 0] * rng.choice([-1.0, 1.0])
                back = layout.objects[bed].box.half[0, 2] - layout.size_of(model)[2] / 2
                direction = side / np.linalg.norm(side)
                front = -layout.objects[bed].rotation[:2, 2]
                left = np.array([-direction[1], direction[0]])
                along = -back * float(np.sign(left @ front))
                layout.beside(bed, model, direction, along=along, facing="same")

    def bathtub(self) -> None:
        """A bathtub along a wall, a cabinet and perhaps a stool."""
        tub = self.draw("bathtub")
        if tub is not None:
            self.layout.at_wall(tub)
        cabinet = self.draw("cabinet")
        if cabinet is not None:
            self.layout.at_wall(cabinet)


def _office(furnisher: Furnisher) -> None:
    for _ in range(int(furnisher.layout.rng.integers(1, 5))):
        furnisher.desk()


def _living(furnisher: Furnisher) -> None:
    furnisher.sofa_corner()
    if furnisher.layout.rng.random() < 0.4:
        furnisher.table_with_chairs(most=4)


def _bedroom(furnisher: Furnisher) -> None:
    furnisher.bed()
    if furnisher.layout.rng.random() < 0.5:
        furnisher.desk()


def _dining(furnisher: Furnisher) -> None:
    furnisher.table_with_chairs(most=8)


def _meeting(furnisher: Furnisher) -> None:
    furnisher.table_with_chairs(most=12)
    furnisher.television()


_GROUPS: dict[str, Callable[[Furnisher], None]] = {
    "office": _office,
    "living": _living,
    "bedroom": _bedroom,
    "dining": _dining,
    "meeting": _meeting,
    "bathroom": Furnisher.bathtub,
}
