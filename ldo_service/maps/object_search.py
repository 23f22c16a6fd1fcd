"""Where something is that somebody names: the objects of a map that answer to a text."""

from dataclasses import dataclass

import numpy as np

from ldo_service.errors import DataError
from ldo_service.schemas import MapObjects, Pose
from ldo_service.semantics.text_search import Encode, TextComparisonError, search, suggest_names


@dataclass(frozen=True, slots=True)
class ObjectMatch:
    """An object, in the map frame; lengths in metres."""

    id: int
    name: str
    score: float  # 0..1, see `semantics.search`
    center: tuple[float, float, float]  # of its box
    size: tuple[float, float, float]  # along the axes of the box
    T_map_object: Pose  # these axes
    distance: float | None  # from where the camera is, or was at the end of the run


def find_objects(
    text: str, found: MapObjects, eye: np.ndarray | None, encode: Encode | None = None
) -> list[ObjectMatch]:
    """Objects that answer to `text`, the best and of equals the nearest to `eye` [3] first. Only
    where none does by its name or another word for it, `encode` is asked which mean nearly the
    same.

    Raises DataError when there is none.
    """
    objects = found.objects
    named = [dict(one.distribution) for one in objects]
    hits, why_not = search(text, named), ""
    if not hits and objects and encode is not None:
        try:
            hits = search(text, named, encode)
        except TextComparisonError as error:
            why_not = f" Words were not compared by what they mean: {error}"
    if not hits:
        raise DataError(_nothing(text, [one.name for one in objects]) + why_not)
    answers = []
    for hit in hits:
        one = objects[hit.index]
        center = one.T_map_object.translation
        distance = None if eye is None else float(np.linalg.norm(eye - center))
        about = (one.id, one.name, hit.score, center, one.size, one.T_map_object)
        answers.append(ObjectMatch(*about, distance))
    return sorted(answers, key=lambda one: (-one.score, one.distance or 0, one.id))


def _nothing(text: str, names: list[str]) -> str:
    if not names:
        return "the map has no objects yet: a detector has to find one in three keyframes."
    return f"none of {len(names)} objects answers to {text!r}. {suggest_names(text, names)}"
