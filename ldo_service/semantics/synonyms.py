"""Other words for what networks and people name; the table and its rule are in synonyms.yaml."""

from collections.abc import Mapping
from functools import cache
from importlib import resources

import yaml

from .class_names import COCO, normalised

TABLE = "synonyms.yaml"


def canonical(name: str) -> str:
    """The one name of those that mean the same: "Sofa" is "couch"."""
    plain = normalised(name)
    return _table("same").get(plain, plain)


def coco_class(name: str) -> str | None:
    """The class of COCO that its annotators would have used: "desk" is "dining table".

    None for what COCO has no class for.
    """
    plain = canonical(name)
    found = _table("kinds").get(plain, plain)
    return found if found in COCO else None


def answers_to(query: str) -> tuple[str, ...]:
    """Names of what somebody means who asks for `query`, nearest first: the thing itself, the class
    of COCO whose kind it is, for detectors know no finer word, and its own kinds."""
    plain = canonical(query)
    kinds = _table("kinds")
    above = [kinds[plain]] if plain in kinds else []
    return (plain, *above, *(kind for kind, of in kinds.items() if of == plain))


@cache
def _table(column: str) -> Mapping[str, str]:
    """Class by word, of the column `same` or `kinds`."""
    text = resources.files("ldo_service.semantics").joinpath(TABLE).read_text("utf-8")
    rows: dict[str, dict[str, list[str]]] = yaml.safe_load(text)
    return {word: name for name, row in rows.items() for word in row.get(column, ())}
