# SPDX-License-Identifier: Apache-2.0
"""Kinds of furniture: class, ShapeNet's synset, and where a piece of the kind stands."""

from __future__ import annotations

from dataclasses import dataclass

from raytran.structs import CLASS_BY_CATID

_CATID = {name: catid for catid, name in CLASS_BY_CATID.items()}


@dataclass(frozen=True)
class Kind:
    """What all pieces of one kind have in common.

    Attributes:
        category: one of ``raytran.structs.CLASSES``.
        catid: ShapeNet's synset.
        support: where it stands (see ``CadModel.support``).
    """

    category: str
    catid: str
    support: str


def _of(category: str, **support: str) -> dict[str, Kind]:
    """Return kinds of a class that has its own synset, given as ``name=support``, ``_`` for a space."""
    return {
        name.replace("_", " "): Kind(category, _CATID[category], where) for name, where in support.items()
    }


KINDS: dict[str, Kind] = {
    **_of("bathtub", bathtub="wall"),
    **_of("bookshelf", bookshelf="wall"),
    **_of("cabinet", cabinet="wall", chest_of_drawers="wall", night_stand="wall", sideboard="wall"),
    **_of("cabinet", tv_cabinet="wall", wardrobe="wall"),
    **_of("chair", armchair="floor", armed_chair="floor", dining_chair="floor", office_chair="floor"),
    **_of("chair", child_chair="floor", floor_chair="floor", high_chair="floor", school_chair="floor"),
    **_of("chair", stool="floor"),
    **_of("display", monitor="table", television="table"),
    **_of("sofa", sofa="wall", corner_sofa="wall"),
    **_of("table", bar_table="floor", coffee_table="floor", dining_table="floor", desk="floor"),
    **_of("table", child_table="floor", dressing_table="wall", workbench="wall"),
    **_of("trashbin", bin="floor"),
    "basket": Kind("other", "02801938", "floor"),
    "bed": Kind("other", "02818832", "wall"),
    "bench": Kind("other", "02828884", "wall"),
    "bunk bed": Kind("other", "02818832", "wall"),
    "crib": Kind("other", "02818832", "wall"),
    "file cabinet": Kind("other", "03337140", "wall"),
    "floor lamp": Kind("other", "03636649", "floor"),
    "flowerpot": Kind("other", "03991062", "floor"),
    "laptop": Kind("other", "03642806", "table"),
    "microwave": Kind("other", "03761084", "table"),
    "piano": Kind("other", "03928116", "wall"),
    "pillow": Kind("other", "03938244", "bed"),
    "printer": Kind("other", "04004475", "table"),
    "speaker": Kind("other", "03691459", "floor"),
    "stove": Kind("other", "04330267", "wall"),
    "table lamp": Kind("other", "03636649", "table"),
    "washing machine": Kind("other", "04554684", "wall"),
}
"""Kinds by name, as ``furnish`` asks for them."""
