"""Search for objects of the map by text."""

from dataclasses import dataclass

import numpy as np

from ldo_service.errors import DataError
from ldo_service.schemas import MapObjects, Pose
from ldo_service.semantics.text_search import (
    TextComparisonError,
    TextEncoder,
    nearest_names,
    search,
    suggest_names,
)


@dataclass(frozen=True, slots=True)
class ObjectMatch:
    """Object that matches a text query, with positions in the map frame; lengths in meters."""

    id: int
    name: str
    score: float  # Similarity of name and query, 0..1, see `semantics.text_search`.
    center: tuple[float, float, float]  # Center of the object's box.
    size: tuple[float, float, float]  # Size along the axes of the box.
    T_map_object: Pose  # Center and axes of the box.
    # Distance of the center from the camera or, after a run, from its last position; None if no
    # camera position is known.
    distance: float | None


def find_objects(
    text: str, found: MapObjects, eye: np.ndarray | None, encoder: TextEncoder | None = None
) -> list[ObjectMatch]:
    """Return the objects that match a text, the best match first.

    Among equally good matches, the object nearest to the camera comes first. If no name or synonym
    matches, `encoder` is used to find objects with names of similar meaning.

    Args:
        text: Text query.
        found: The objects of the map.
        eye: Camera position in the map frame, [3], meters; None if unknown.
        encoder: Text encoder; None compares names and synonyms only.

    Raises:
        DataError: No object matches.
    """
    names = [one.name for one in found.objects]
    hits, note = _ranked(text, found), ""
    if not hits and names and encoder is not None:
        try:
            hits = _ranked(text, found, encoder)
            note = "" if hits else _nearest(text, names, encoder)
        except TextComparisonError as error:
            note = f" Names of similar meaning were not searched: {error}"
    if not hits:
        raise DataError(_nothing(text, names) + note)
    return _sorted([_match(found, index, score, eye) for index, score in hits])


def matching_objects(
    text: str | None, found: MapObjects, eye: np.ndarray | None
) -> list[ObjectMatch]:
    """Return the objects whose name or synonym matches a text, the best match first.

    Args:
        text: Text query; None for all objects, each with the score 1.
        found: The objects of the map.
        eye: Camera position in the map frame, [3], meters; None if unknown.
    """
    if text is None:
        hits = [(index, 1.0) for index in range(len(found.objects))]
    else:
        hits = _ranked(text, found)
    return _sorted([_match(found, index, score, eye) for index, score in hits])


def _ranked(
    text: str, found: MapObjects, encoder: TextEncoder | None = None
) -> list[tuple[int, float]]:
    """Return index and score of the objects that match a text.

    Raises:
        TextComparisonError: The text encoder cannot be used.
    """
    named = [dict(one.distribution) for one in found.objects]
    return [(hit.index, hit.score) for hit in search(text, named, encoder)]


def _match(found: MapObjects, index: int, score: float, eye: np.ndarray | None) -> ObjectMatch:
    one = found.objects[index]
    center = one.T_map_object.translation
    distance = None if eye is None else float(np.linalg.norm(eye - center))
    about = (one.id, one.name, score, center, one.size, one.T_map_object)
    return ObjectMatch(*about, distance)


def _sorted(matches: list[ObjectMatch]) -> list[ObjectMatch]:
    return sorted(matches, key=lambda one: (-one.score, one.distance or 0, one.id))


def _nothing(text: str, names: list[str]) -> str:
    if not names:
        return "the map has no objects yet: a detector must detect an object in three keyframes."
    return f"none of {len(names)} objects matches {text!r}. {suggest_names(text, names)}"


def _nearest(text: str, names: list[str], encoder: TextEncoder) -> str:
    """Return a sentence with the names nearest in meaning, because one may still be wanted.

    Raises:
        TextComparisonError: The text encoder cannot be used.
    """
    near = nearest_names(text, names, encoder)
    listed = ", ".join(f"{name} ({cosine:.2f})" for name, cosine in near)
    return f" No name is similar in meaning. The nearest names, with their cosines, are {listed}."
