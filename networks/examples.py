"""What the detector learns from: frames moved, zoomed, mirrored, repainted and made worse."""

from collections.abc import Iterator
from itertools import islice

import cv2
import numpy as np
from cells import ID_COUNT, INPUT_PX, THINGS, told, visible
from views import Seen, Views
from wear import repainted, worsened

from ldo_service.datasets.synthetic.flat.labels import CLASS_NAMES

BATCH = 8
PADDING = 114
ZOOM = (0.8, 1.5)


def batches(material: Views, rng: np.random.Generator) -> Iterator[tuple]:
    """Frames in random order without end, each with what its cells are to tell."""
    names = _names_of_ids(material)
    order = _shuffled(len(material.colors), rng)
    while True:
        examples = [
            _example(material.colors[f], material.instances[f], names[f], rng)
            for f in islice(order, BATCH)
        ]
        yield tuple(map(np.array, zip(*examples, strict=True)))


def _shuffled(count: int, rng: np.random.Generator) -> Iterator[int]:
    """Every index once, then again in another order, without end."""
    while True:
        yield from rng.permutation(count)


def _names_of_ids(material: Views) -> np.ndarray:
    """Names [F, 256] of the ids of each frame, -1 for none."""
    seen: Seen = material.seen
    names = np.full((len(material.colors), ID_COUNT), -1)
    own = {CLASS_NAMES.index(name): k for k, name in enumerate(THINGS)}
    named = seen.chosen(seen.instances > 0)
    names[named.frames, named.instances] = [own[k] for k in named.class_ids.tolist()]
    return names


def _example(
    color: np.ndarray, plane: np.ndarray, names: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """An image of the input's size, and what its cells are to tell."""
    color = worsened(repainted(color, plane, rng), rng)
    zoom, is_mirrored = rng.uniform(*ZOOM), rng.random() < 0.5
    size = np.array(color.shape[1::-1])
    shift = (np.array(INPUT_PX) - zoom * size) * rng.uniform(0, 1, 2)
    A = np.array([[zoom, 0, shift[0]], [0, zoom, shift[1]]])
    A[:, 2] += zoom / 2 - 0.5  # OpenCV counts from the middles of pixels
    way = cv2.INTER_AREA if zoom < 0.9 else cv2.INTER_LINEAR
    color = cv2.warpAffine(color, A, INPUT_PX, flags=way, borderValue=(PADDING,) * 3)
    plane = cv2.warpAffine(plane, A, INPUT_PX, flags=cv2.INTER_NEAREST, borderValue=0)
    if is_mirrored:
        color, plane = color[:, ::-1], plane[:, ::-1]
    return color, *told(plane, visible(plane, names))
