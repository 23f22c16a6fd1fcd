"""The detector's grids, and the training targets of their cells."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ldo_service.synthetic.flat.catalog import CATALOG
from ldo_service.synthetic.flat.scene_object import CLASS_NAMES, COCO_COUNT

INPUT_PX = (320, 256)  # Width and height.
STRIDES_PX = (8, 16, 32)
CELL_COUNT = sum(INPUT_PX[1] // s * (INPUT_PX[0] // s) for s in STRIDES_PX)
THINGS = tuple(name for name in CLASS_NAMES if name in CATALOG)
NAMES = tuple(name for name in CLASS_NAMES[:COCO_COUNT] if name in CATALOG)  # First in THINGS.
NOTHING = len(THINGS)  # Index of the background.

# Range of sqrt(box area) of the objects whose boxes a grid predicts, for each grid.
SIDES_PX = ((0, 56), (40, 130), (96, 1000))
BOXES_CELLS = 1.5  # Initial distance from the center of a cell to each side of its box, in cells.
# A cell can predict an object if the object covers at least the fraction COVERED of the cell, or if
# at least the fraction OF_OBJECT of the object's pixels lies in the cell.
COVERED, OF_OBJECT = 0.4, 0.25
# A cell that predicts no object has weight 0 if objects cover more than this fraction of the cell.
UNCLEAR = 0.3
NOTHING_WEIGHT = 0.1  # Weight of a background cell of the finest grid in the loss.
MIN_PX = 20  # Minimum visible pixels of an object in the targets.
ID_COUNT = 256  # Number of instance ids in a frame.


def grid(size_px: tuple[int, int] = INPUT_PX) -> tuple[np.ndarray, np.ndarray]:
    """Return the centers [N, 2] and sides [N, 1] of all cells in pixels, finest grid first."""
    middles, sides = [], []
    for stride in STRIDES_PX:
        columns, rows = (side // stride for side in size_px)
        cells = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
        middles.append((cells.reshape(-1, 2) + 0.5) * stride)
        sides.append(np.full((rows * columns, 1), stride))
    return np.concatenate(middles).astype(np.float32), np.concatenate(sides).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Visible:
    """The M visible objects of a frame."""

    ids: np.ndarray  # Instance ids [M].
    names: np.ndarray  # Indices [M] into THINGS.
    boxes_px: np.ndarray  # Boxes [M, 4], x0, y0, x1, y1.
    pixels: np.ndarray  # Number of visible pixels [M].


def visible(plane: np.ndarray, names: np.ndarray) -> Visible:
    """Return the visible objects of a frame.

    Args:
        plane: Instance ids [H, W].
        names: Index into THINGS of each instance id, [256]; -1 for an id without an object.
    """
    pixels = np.bincount(plane.ravel(), minlength=ID_COUNT)
    ids = np.flatnonzero((pixels >= MIN_PX) & (names >= 0))
    extents = ndimage.find_objects(plane)
    boxes = [
        (columns.start, rows.start, columns.stop, rows.stop)
        for rows, columns in (extents[k - 1] for k in ids)
    ]
    return Visible(ids, names[ids], np.array(boxes, np.float32).reshape(-1, 4), pixels[ids])


def make_targets(plane: np.ndarray, objects: Visible) -> tuple[np.ndarray, ...]:
    """Return the training targets of all N cells.

    The target of a cell is the smallest object that covers at least the fraction COVERED of the
    cell, or that has at least the fraction OF_OBJECT of its pixels in the cell.

    Args:
        plane: Instance ids [H, W].
        objects: The visible objects of the frame.

    Returns:
        Names [N] (indices into THINGS, or NOTHING), weights [N] in the loss, boxes [N, 4]
        (x0 y0 x1 y1, pixels), and a mask [N] of the cells that predict a box.
    """
    order = np.argsort(objects.pixels, kind="stable")
    place = np.full(ID_COUNT, len(order))
    place[objects.ids[order]] = np.arange(len(order))
    counts = _counts(place[plane], len(order) + 1)
    sides = np.sqrt(np.prod(objects.boxes_px[:, 2:] - objects.boxes_px[:, :2], axis=1))[order]
    parts = [
        _of_grid(count, stride, objects.pixels[order], (sides >= low) & (sides < high))
        for count, stride, (low, high) in zip(counts, STRIDES_PX, SIDES_PX, strict=True)
    ]
    owners, shares, tells_box = (np.concatenate(part) for part in zip(*parts, strict=True))
    names = np.append(objects.names[order], NOTHING).astype(np.int32)[owners]
    boxes = np.concatenate([objects.boxes_px[order], np.zeros((1, 4), np.float32)])[owners]
    return names, shares.astype(np.float32), boxes, tells_box


def _counts(plane: np.ndarray, kinds: int) -> list[np.ndarray]:
    """Return the number of pixels of each object in each cell, one array [cells, kinds] per grid.

    Args:
        plane: Object of each pixel, [H, W], 0..kinds-1; kinds-1 is the background.
        kinds: Number of objects, plus one for the background.
    """
    stride = STRIDES_PX[0]
    rows, columns = (side // stride for side in plane.shape)
    v, u = np.divmod(np.arange(plane.size), plane.shape[1])
    cell = v // stride * columns + u // stride
    fine = np.bincount(cell * kinds + plane.ravel(), minlength=rows * columns * kinds)
    counts = [fine.reshape(rows, columns, kinds)]
    for _ in STRIDES_PX[1:]:
        rows, columns = rows // 2, columns // 2
        counts.append(counts[-1].reshape(rows, 2, columns, 2, kinds).sum(axis=(1, 3)))
    return [count.reshape(-1, kinds) for count in counts]


def _of_grid(
    counts: np.ndarray, stride_px: int, pixels: np.ndarray, is_for: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Return the targets of the cells of one grid.

    Args:
        counts: Number of pixels of each object in each cell, [cells, M + 1]. The objects ascend by
            size; the background comes last.
        stride_px: Side of a cell.
        pixels: Number of visible pixels of each object, [M].
        is_for: Objects whose boxes this grid predicts, [M] bool.

    Returns:
        For each cell: the index of the object that it predicts, or M for the background; its weight
        in the loss; and whether it predicts a box.
    """
    things = counts[:, :-1]
    is_owned = (things >= COVERED * stride_px**2) | (things >= OF_OBJECT * pixels)
    is_owned = np.column_stack((is_owned, np.ones(len(counts), bool)))
    owners = is_owned.argmax(axis=1)  # The first one is the smallest object.
    sizes = np.bincount(owners, minlength=counts.shape[1])
    weights = 1 / np.sqrt(np.maximum(sizes, 1))
    weights[-1] = NOTHING_WEIGHT * stride_px / STRIDES_PX[0]
    shares = weights[owners]
    is_nothing = owners == len(pixels)
    shares[is_nothing & (things.sum(axis=1) > UNCLEAR * stride_px**2)] = 0
    return owners, shares, np.append(is_for, False)[owners]
