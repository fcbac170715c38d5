# SPDX-License-Identifier: Apache-2.0
"""Rooms as people leave them: many chairs, tables and cabinets in rows, and things lying about."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from raytran.rooms.cad import CLUTTER, CadModel, finish_model
from raytran.rooms.furnish import Furnisher
from raytran.rooms.parametric.clutter import IN_SHELVES, ON_FLOORS, ON_SEATS, ON_TABLES, Thing

ROOM_KINDS = {
    "office": 0.25,
    "living": 0.25,
    "bedroom": 0.1,
    "dining": 0.1,
    "meeting": 0.12,
    "bathroom": 0.18,
}
"""What a room can be used for, and how often."""

_EXTRAS: dict[str, dict[str, float]] = {
    "office": {
        **{"chair": 3, "table": 4, "trashbin": 4, "display": 6, "bookshelf": 4, "cabinet": 4, "sofa": 2},
        **{"printer": 1, "lamp": 0.5},
    },
    "living": {
        **{"chair": 2, "table": 5, "sofa": 4, "display": 2, "bookshelf": 3, "cabinet": 3, "trashbin": 2},
        **{"lamp": 1.5, "pillow": 1},
    },
    "bedroom": {
        **{"chair": 2, "table": 3, "cabinet": 3, "display": 1, "sofa": 1, "bookshelf": 2, "trashbin": 2},
        **{"lamp": 1.5, "pillow": 1},
    },
    "dining": {"chair": 3, "table": 4, "trashbin": 2, "cabinet": 3, "sofa": 2, "bookshelf": 2, "lamp": 1},
    "meeting": {
        **{"chair": 3, "table": 4, "display": 4, "trashbin": 2, "sofa": 2, "bookshelf": 3, "cabinet": 3},
        **{"printer": 1},
    },
    "bathroom": {"cabinet": 3, "trashbin": 3, "chair": 0.5, "lamp": 0.5},
}


@dataclass
class BusyFurnisher(Furnisher):
    """A furnisher that also makes rows, pushes chairs under tables and strews clutter."""

    tucked: float = 0.5

    def furnish(self) -> None:
        """Place groups, then single pieces until the number is reached."""
        rng = self.layout.rng
        kind = self.layout.room.kind
        for group in _GROUPS[kind]:
            group(self)
        if kind != "bathroom":
            if rng.random() < 0.1:
                self.row_at_wall(
                    "chair", int(rng.integers(2, 6)), "dining chair", "armed chair", "office chair"
                )
            if rng.random() < 0.15:
                self.row_at_wall(str(rng.choice(["cabinet", "bookshelf"])), int(rng.integers(2, 5)))
        self.fill_up(_EXTRAS[kind], given_share=0.5)

    def row_at_wall(self, category: str, count: int, *kinds: str) -> None:
        """Place pieces of one model side by side at a wall."""
        model = self.draw(category, *kinds)
        first = None if model is None else self.layout.at_wall(model)
        if model is not None and first is not None:
            self.row_beside(first, model, count - 1)

    def row_beside(self, first: int, model: CadModel, count: int) -> list[int]:
        """Place more of a model in a row to one side of the first; return their numbers."""
        layout, placed, last = self.layout, [], first
        side = layout.objects[first].rotation[:2, 0] * layout.rng.choice([-1.0, 1.0])
        side = side / np.linalg.norm(side)
        for _ in range(count):
            if self.room_left <= 0:
                break
            found = layout.beside(last, model, side, along=0.0, facing="same")
            if found is None:
                break
            placed.append(found)
            last = found
        return placed

    def desks_in_a_row(self) -> None:
        """Two to four equal desks side by side, each with a chair and most with a display."""
        rng, layout = self.layout.rng, self.layout
        model = self.draw("table", "desk", "dining table")
        first = (
            None if model is None else layout.at_wall(model) if rng.random() < 0.6 else layout.anywhere(model)
        )
        if model is None or first is None:
            return
        screen, chair = self.draw("display", "monitor"), self.draw("chair", "office chair", "armed chair")
        for desk in [first, *self.row_beside(first, model, int(rng.integers(1, 4)))]:
            if screen is not None and self.room_left > 0 and rng.random() < 0.75:
                layout.on_top(desk, screen, place=(rng.uniform(-0.4, 0.4), rng.uniform(0.2, 0.6)))
            if self.room_left > 0 and rng.random() < 0.85:
                self.chair_at(desk, chair, rng.uniform(-0.15, 0.15))

    def tables_in_a_row(self) -> None:
        """Two or three equal tables in a row with chairs all round, or standing apart."""
        rng, layout = self.layout.rng, self.layout
        model = self.draw("table", "dining table", "desk")
        first = None if model is None else layout.anywhere(model)
        if model is None or first is None:
            return
        more = self.row_beside(first, model, int(rng.integers(1, 3))) if rng.random() < 0.6 else []
        if not more:
            found = layout.anywhere(model)
            more = [] if found is None else [found]
        for table in [first, *more]:
            self.seats_round(table, most=4)

    def lounge(self) -> None:
        """A second sofa or armchairs near the sofa's table, or a round table with chairs."""
        rng = self.layout.rng
        if rng.random() < 0.5:
            for _ in range(int(rng.integers(1, 3))):
                chair = self.draw("chair", "armchair", "armed chair")
                if chair is not None:
                    self.layout.anywhere(chair)
        else:
            self.table_with_chairs(most=4)

    def strew(self, density: float) -> None:
        """Put clutter on tables, seats and boards and on the floor.

        Args:
            density: about 1 in a room that is lived in.
        """
        rng, layout = self.layout.rng, self.layout
        for number, placed in enumerate(list(layout.objects)):
            category, kind = placed.model.category, placed.model.kind
            if category in ("table", "cabinet") or kind in ("file cabinet", "piano"):
                for _ in range(min(int(rng.poisson(1.6 * density)), 5)):
                    layout.on_top(number, _draw(ON_TABLES, rng), turn=rng.uniform(-0.6, 0.6))
            elif category == "bookshelf" and rng.random() < 0.85:
                for _ in range(min(int(rng.poisson(6 * density)), 12)):
                    layout.in_shelf(number, _draw(IN_SHELVES, rng))
            elif (category == "sofa" or kind == "bed") and rng.random() < 0.5 * density:
                layout.on_top(number, _draw(ON_SEATS, rng), turn=rng.uniform(-3, 3))
            elif category == "chair" and rng.random() < 0.08 * density:
                layout.on_top(number, _draw(ON_SEATS, rng), place=(0.0, -0.2))
        area = layout.room.size[0] * layout.room.size[1]
        for _ in range(min(int(rng.poisson(0.2 * density * area)), 12)):
            model = _draw(ON_FLOORS, rng)
            if model.kind in ("cable", "toys", "person") or rng.random() < 0.2:
                layout.anywhere(model)
            else:
                layout.at_wall(model)


def _draw(things: Mapping[Thing, float], rng: np.random.Generator) -> CadModel:
    """Draw one of the things by their weights."""
    weights: NDArray[np.float64] = np.array(list(things.values()))
    thing = list(things)[int(rng.choice(len(weights), p=weights / weights.sum()))]
    return finish_model(CLUTTER, thing(rng))


def _often(share: float, group: Callable[[BusyFurnisher], None]) -> Callable[[BusyFurnisher], None]:
    """Return a group that is placed in a share of the rooms."""

    def perhaps(furnisher: BusyFurnisher) -> None:
        if furnisher.layout.rng.random() < share:
            group(furnisher)

    return perhaps


def _few_seats(furnisher: BusyFurnisher) -> None:
    furnisher.table_with_chairs(most=6)


def _many_seats(furnisher: BusyFurnisher) -> None:
    furnisher.table_with_chairs(most=12)


_GROUPS: dict[str, tuple[Callable[[BusyFurnisher], None], ...]] = {
    "office": (
        _often(0.6, BusyFurnisher.desks_in_a_row),
        _often(0.7, Furnisher.desk),
        _often(0.4, Furnisher.desk),
        _often(0.25, _few_seats),
    ),
    "living": (Furnisher.sofa_corner, _often(0.7, BusyFurnisher.lounge), _often(0.4, _few_seats)),
    "bedroom": (_often(0.85, Furnisher.bed), _often(0.6, Furnisher.desk)),
    "dining": (_few_seats, _often(0.5, BusyFurnisher.tables_in_a_row), _often(0.2, Furnisher.sofa_corner)),
    "meeting": (_many_seats, _often(0.4, BusyFurnisher.tables_in_a_row), _often(0.4, Furnisher.television)),
    "bathroom": (Furnisher.bathtub,),
}
