"""Training examples of the detector: shifted, zoomed, mirrored, recolored and degraded frames."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import cv2
import numpy as np
from cells import ID_COUNT, INPUT_PX, THINGS, make_targets, visible
from views import Views, VisibleBoxes
from wear import BLUR_PX, degrade, recolor

from ldo_service.synthetic.flat.scene_object import CLASS_NAMES

BATCH = 8
PADDING = 114  # Gray level outside the frame.


@dataclass(frozen=True, slots=True)
class Canvas:
    """Size of a training image, and range of the random scale of the frame in the image."""

    size_px: tuple[int, int] = INPUT_PX  # Width and height, multiples of the widest cell.
    zoom: tuple[float, float] = (0.8, 1.5)  # Minimum and maximum.


# Canvas of the first training round, with three eighths of the pixels of the second round. Objects
# are at most about as large as in the second round.
SMALL = Canvas((192, 160), (0.5, 1.2))


def batches(
    material: Views, rng: np.random.Generator, canvas: Canvas = Canvas()
) -> Iterator[tuple]:
    """Yield batches of augmented frames in random order, without end.

    Yields:
        Images [BATCH, H, W, 3] uint8, and the targets of their cells as in `cells.make_targets`,
        each with a first dimension BATCH.
    """
    names = _names_of_ids(material)
    order = _shuffled(len(material.colors), rng)
    while True:
        examples = [
            _example(material.colors[f], material.instances[f], names[f], canvas, rng)
            for f in islice(order, BATCH)
        ]
        yield tuple(map(np.array, zip(*examples, strict=True)))


def _shuffled(count: int, rng: np.random.Generator) -> Iterator[int]:
    """Yield the indices 0..count-1 in random order, then in another random order, without end."""
    while True:
        yield from rng.permutation(count)


def _names_of_ids(material: Views) -> np.ndarray:
    """Return the index into THINGS of each instance id in each frame, [F, 256]; -1 for none."""
    seen: VisibleBoxes = material.seen
    names = np.full((len(material.colors), ID_COUNT), -1)
    own = {CLASS_NAMES.index(name): k for k, name in enumerate(THINGS)}
    named = seen.chosen(seen.instances > 0)
    names[named.frames, named.instances] = [own[k] for k in named.class_ids.tolist()]
    return names


def _example(
    color: np.ndarray,
    plane: np.ndarray,
    names: np.ndarray,
    canvas: Canvas,
    rng: np.random.Generator,
) -> tuple[np.ndarray, ...]:
    """Return an augmented image of the size of the canvas, and the targets of its cells.

    Args:
        color: Frame [H, W, 3] uint8 RGB.
        plane: Instance ids [H, W].
        names: Index into THINGS of each instance id, [256]; -1 for none.
        canvas: Size of the result and range of the zoom.
        rng: Source of the augmentation.
    """
    zoom = rng.uniform(*canvas.zoom)
    place_px = (np.array(canvas.size_px) - zoom * np.array(color.shape[1::-1])) * rng.random(2)
    seen, shown = _windows(color.shape[1::-1], place_px, zoom, canvas.size_px)
    color, plane = color[seen], plane[seen]
    size_px = shown[1].stop - shown[1].start, shown[0].stop - shown[0].start
    if zoom < 1:  # Shrink before the degradation, which then has fewer pixels.
        color = cv2.resize(color, size_px, interpolation=cv2.INTER_AREA)
        plane = cv2.resize(plane, size_px, interpolation=cv2.INTER_NEAREST)
    color = degrade(recolor(color, plane, rng), rng, BLUR_PX * min(zoom, 1))
    image = np.full((*canvas.size_px[::-1], 3), PADDING, np.uint8)
    ids = np.zeros(image.shape[:2], np.uint8)
    image[shown] = cv2.resize(color, size_px)
    ids[shown] = cv2.resize(plane, size_px, interpolation=cv2.INTER_NEAREST)
    if rng.random() < 0.5:
        image, ids = image[:, ::-1], ids[:, ::-1]
    return image, *make_targets(ids, visible(ids, names))


def _windows(
    size_px: tuple[int, int], place_px: np.ndarray, zoom: float, canvas_px: tuple[int, int]
) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return the part of a frame that lies on the canvas, and the part of the canvas that it fills.

    Args:
        size_px: Width and height of the frame.
        place_px: Position [2] of the frame's upper left corner on the canvas.
        zoom: Zoom of the frame.
        canvas_px: Width and height of the canvas.

    Returns:
        Rows and columns of the frame, and rows and columns of the canvas.
    """
    first = np.maximum(-place_px / zoom, 0).astype(int)
    stop = np.minimum(np.ceil((canvas_px - place_px) / zoom), size_px).astype(int)
    start = np.maximum(np.round(place_px + zoom * first), 0).astype(int)
    end = np.minimum(np.round(place_px + zoom * stop), canvas_px).astype(int)
    rows_columns = [
        tuple(slice(*ends) for ends in zip(low[::-1], high[::-1], strict=True))
        for low, high in ((first, stop), (start, end))
    ]
    return rows_columns[0], rows_columns[1]
