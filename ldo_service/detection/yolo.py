"""Input and output of networks of the YOLO family.

The networks predict boxes in the cells of grids over the input, one grid for each stride. The
number of boxes therefore determines the layout of the output. As a check, the predicted boxes must
lie near their cells.

            input                          output
    yolov5  RGB 0..1, centered             [1, 3*cells, 5 + C] cx, cy, w, h, objectness, classes
    yolox   BGR 0..255, upper left corner  [1, cells, 5 + C] as yolov5, with offsets and log sizes
    yolov8  RGB 0..1, centered             [1, 4 + C, cells] cx, cy, w, h, classes

Here, `cells` is the number of cells of all grids, and C the number of classes. In yolox, the center
of a box is an offset from its cell, and its size is a logarithm; networks exported with
`--decode_in_inference` output pixels, as the other layouts do. YOLOv7 has the layout of YOLOv5.
YOLOv9 and YOLO11 have the layout of YOLOv8.

An image is scaled to fit into the input of a network (letterbox). It lies in the center or in the
upper left corner of the input. The boxes are scaled back to the image. Of overlapping boxes of one
class, non-maximum suppression keeps the one with the highest score.
"""

from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from ldo_service.errors import ConfigError, ModelError

# Strides of known networks; each network has one or several consecutive strides of this list.
STRIDES_PX = (4, 8, 16, 32, 64)
# Maximum median distance of box centers from their cells, in cells. The networks place each side of
# a box at most 16 cells from its cell, and therefore the center at most 8.
CELLS_APART = 8
SCORE_TOLERANCE = 1e-3  # Maximum excess of a score over 0..1, which rounding may cause.
EXPECTED = (
    "[1, N, 5 + C] with three boxes per grid cell (yolov5) or one box (yolox), or [1, 4 + C, N] "
    "(yolov8), for N boxes and C classes, with consecutive grid strides such as 8, 16 and 32 "
    "pixels, without non-maximum suppression"
)

PADDING = 114  # Gray value that pads the images in the training of YOLO networks.


@dataclass(frozen=True, slots=True)
class Layout:
    """Format of the input and the output of one kind of network."""

    name: str
    boxes_per_cell: int
    has_objectness: bool  # True: a score for any object precedes the scores of the classes.
    is_channels_first: bool  # True: the output is [1, channels, N]; false: [1, N, channels].
    is_centered: bool  # True: the image is in the center of the padded input; false: upper left.
    is_rgb: bool  # True: the colors of the input are RGB; false: BGR.
    value_scale: float  # Factor that converts pixel values 0..255 to values of the input.


LAYOUTS = {
    layout.name: layout
    for layout in (
        Layout("yolov5", 3, True, False, is_centered=True, is_rgb=True, value_scale=1 / 255),
        Layout("yolox", 1, True, False, is_centered=False, is_rgb=False, value_scale=1.0),
        Layout("yolov8", 1, False, True, is_centered=True, is_rgb=True, value_scale=1 / 255),
    )
}


@dataclass(frozen=True, slots=True)
class Grid:
    """Grid cells in which a network predicts its boxes.

    Attributes:
        corners_px: Upper left corner of the cell of each box, [N, 2], pixels of the input.
        strides_px: Side of the cell of each box, [N, 1], pixels of the input.
        boxes_per_cell: Number of boxes per cell.
    """

    corners_px: np.ndarray
    strides_px: np.ndarray
    boxes_per_cell: int

    def cells_apart(self, centers_px: np.ndarray) -> float:
        """Return the median distance of box centers [N, 2] from their cells' centers, in cells."""
        middles_px = self.corners_px + self.strides_px / 2
        return float(np.median(np.abs(centers_px - middles_px) / self.strides_px))


@dataclass(frozen=True, slots=True)
class Candidates:
    """Boxes before non-maximum suppression."""

    boxes: np.ndarray  # [M, 4], x0, y0, x1, y1, pixels from the upper left corner of the input.
    scores: np.ndarray  # [M], 0..1.
    class_ids: np.ndarray  # [M], indices of the classes.


@dataclass(frozen=True, slots=True)
class Head:
    """Output of one network: its layout, number of classes and grid."""

    layout: Layout
    class_count: int
    grid: Grid | None  # Grid of the boxes; None if unknown, and the boxes are then not checked.
    is_decoded: bool  # True: boxes are in pixels; false: offsets from their cells and log sizes.

    def candidates(self, output: np.ndarray, score_min: float) -> Candidates:
        """Return the boxes whose best class has a score of at least `score_min`.

        The score of a class is the product of its output and the objectness. In layouts without
        objectness, it is the output of the class.
        """
        rows = _rows(output, self.layout)
        scores = self._scores(rows)  # Cheap upper bounds, which exclude most boxes.
        chosen = np.flatnonzero(scores >= score_min)
        classes = rows[chosen, self._first_class :]
        class_ids = classes.argmax(axis=1)
        best = classes[np.arange(len(chosen)), class_ids]
        if self.layout.has_objectness:
            best = best * rows[chosen, 4]
        passed = best >= score_min
        boxes = self._decoded(rows, chosen[passed])
        return Candidates(_corners(boxes), best[passed], class_ids[passed])

    def check(self, output: np.ndarray) -> None:
        """Check that scores are probabilities and boxes lie near their cells.

        Raises:
            ModelError: If a score is outside 0..1, or boxes lie far from their cells.
        """
        scores = _rows(output, self.layout)[:, 4:]
        low, high = float(scores.min()), float(scores.max())
        if low < -SCORE_TOLERANCE or high > 1 + SCORE_TOLERANCE:
            raise ModelError(
                f"with the layout {self.layout.name}, the scores range from {low:.3g} to "
                f"{high:.3g}, so they are no probabilities in 0..1: export the network with its "
                "final sigmoid."
            )
        if self.cells_apart(output) > CELLS_APART:
            raise ModelError(
                f"with the layout {self.layout.name}, the median distance of a box from the grid "
                f"cell that predicts it is {self.cells_apart(output):.0f} cells, expected at most "
                f"{CELLS_APART:g}: export the network with boxes in pixels."
            )

    def cells_apart(self, output: np.ndarray) -> float:
        """Return the median distance of the boxes from the grid cells that predict them.

        The unit is the edge of a grid cell. The result is 0 if the layout has no grid of cells.
        """
        if self.grid is None:
            return 0.0
        rows = _rows(output, self.layout)
        return self.grid.cells_apart(self._decoded(rows, np.arange(len(rows)))[:, :2])

    @property
    def _first_class(self) -> int:
        return 5 if self.layout.has_objectness else 4

    def _scores(self, rows: np.ndarray) -> np.ndarray:
        """Return an upper bound of the score of each box, [N]."""
        return rows[:, 4] if self.layout.has_objectness else rows[:, 4:].max(axis=1)

    def _decoded(self, rows: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Return cx, cy, w, h of the chosen boxes, [M, 4], pixels."""
        boxes = rows[chosen, :4].astype(np.float64)
        if self.is_decoded or self.grid is None:
            return boxes
        corners, strides = self.grid.corners_px[chosen], self.grid.strides_px[chosen]
        with np.errstate(over="ignore"):  # An absurd size is clipped to the image later.
            return np.hstack((corners + boxes[:, :2] * strides, np.exp(boxes[:, 2:]) * strides))


def detect_layout(output: np.ndarray, input_px: tuple[int, int], wanted: str = "") -> Head:
    """Determine the layout of a network's output, and check the output.

    Args:
        output: The only output of the network, for one image, [1, N, channels] or
            [1, channels, N] float32.
        input_px: Width and height of the network's input.
        wanted: Name of the layout; empty: determine it from the shape of the output.

    Raises:
        ConfigError: If there is no layout of the name `wanted`.
        ModelError: If the output has no known layout or another layout than `wanted`, or fails
            `Head.check`.
    """
    if output.ndim != 3 or output.shape[0] != 1 or output.dtype != np.float32:
        raise ModelError(
            f"the network's output is {output.dtype} {list(output.shape)}. Expected: float32 "
            f"{EXPECTED}. Export the network in one of these layouts."
        )
    layout = layout_named(wanted) if wanted else _layout_of(output, input_px)
    boxes, channels = _rows(output, layout).shape
    class_count = channels - (5 if layout.has_objectness else 4)
    grid = find_grid(boxes, input_px)
    boxes_per_cell = grid.boxes_per_cell if grid else layout.boxes_per_cell
    is_without_cells = layout.name == "yolox" and grid is None
    if class_count < 1 or boxes_per_cell != layout.boxes_per_cell or is_without_cells:
        raise ModelError(
            f"the network's output {list(output.shape)} for an input of "
            f"{input_px[0]}x{input_px[1]} pixels does not have the layout {layout.name}. "
            f"Expected: {EXPECTED}. Choose another layout, or export the network again."
        )
    heads = [Head(layout, class_count, grid, is_decoded=True)]
    if layout.name == "yolox":
        heads.append(Head(layout, class_count, grid, is_decoded=False))
    head = min(heads, key=lambda head: head.cells_apart(output))
    head.check(output)
    return head


def layout_named(name: str) -> Layout:
    """Return a layout by its name.

    Raises:
        ConfigError: If there is no such layout.
    """
    if name not in LAYOUTS:
        raise ConfigError(f"there is no layout {name!r}. Choose from {', '.join(LAYOUTS)}.")
    return LAYOUTS[name]


def find_grid(count: int, input_px: tuple[int, int]) -> Grid | None:
    """Return the grid for a network that predicts `count` boxes, or None if no grid fits.

    A grid has one or several consecutive strides of 4, 8, 16, 32 and 64 pixels, and one or three
    boxes per cell. No two grids for the same input have the same number of boxes. The boxes are
    sorted by stride, the smallest first. With three boxes per cell, the cells of each stride are
    repeated three times, one repetition after the other.

    Args:
        count: Number of boxes.
        input_px: Width and height of the network's input.
    """
    for first, end in combinations(range(len(STRIDES_PX) + 1), 2):
        strides = STRIDES_PX[first:end]
        if any(side % strides[-1] for side in input_px):
            continue
        cells = sum((input_px[0] // stride) * (input_px[1] // stride) for stride in strides)
        if count in (cells, 3 * cells):
            return _grid(input_px, strides, count // cells)
    return None


def _grid(input_px: tuple[int, int], strides: tuple[int, ...], boxes_per_cell: int) -> Grid:
    """Return the grid with these strides for an input of this width and height."""
    corners: list[np.ndarray] = []
    for stride in strides:
        columns, rows = input_px[0] // stride, input_px[1] // stride
        cells = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
        corners.append(np.tile(cells.reshape(-1, 2) * stride, (boxes_per_cell, 1)))
    sides = np.repeat(strides, [len(part) for part in corners])[:, None]
    return Grid(np.concatenate(corners), sides, boxes_per_cell)


def _layout_of(output: np.ndarray, input_px: tuple[int, int]) -> Layout:
    """Return the layout in which the number of boxes of this output fits a grid."""
    for layout in LAYOUTS.values():
        grid = find_grid(len(_rows(output, layout)), input_px)
        if grid is not None and grid.boxes_per_cell == layout.boxes_per_cell:
            return layout
    raise ModelError(
        f"the network's output {list(output.shape)} for an input of "
        f"{input_px[0]}x{input_px[1]} pixels is of no known layout. Expected: {EXPECTED}. Export "
        "the network in one of these layouts."
    )


def _rows(output: np.ndarray, layout: Layout) -> np.ndarray:
    """Return the boxes of an output as rows, [N, channels]."""
    return output[0].T if layout.is_channels_first else output[0]


def _corners(boxes: np.ndarray) -> np.ndarray:
    """Convert boxes [M, 4] from cx, cy, w, h to x0, y0, x1, y1."""
    halves = boxes[:, 2:] / 2
    return np.hstack((boxes[:, :2] - halves, boxes[:, :2] + halves))


@dataclass(frozen=True, slots=True)
class Letterbox:
    """Placement of an image in the input of a network: scaled in proportion and padded with gray.

    Attributes:
        image_px: Width and height of the image.
        input_px: Width and height of the network's input.
        inner_px: Width and height of the scaled image.
        offset_px: Upper left corner of the scaled image in the input.
    """

    image_px: tuple[int, int]
    input_px: tuple[int, int]
    inner_px: tuple[int, int]
    offset_px: tuple[int, int]

    @staticmethod
    def fit(image_px: tuple[int, int], input_px: tuple[int, int], is_centered: bool) -> "Letterbox":
        """Return the placement of the largest scaled image that fits into the input.

        Args:
            image_px: Width and height of the image.
            input_px: Width and height of the network's input.
            is_centered: True: the image is centered (YOLOv5); false: upper left corner (YOLOX).
        """
        scale = min(input_px[0] / image_px[0], input_px[1] / image_px[1])
        inner = max(1, round(image_px[0] * scale)), max(1, round(image_px[1] * scale))
        room = input_px[0] - inner[0], input_px[1] - inner[1]
        offset = (room[0] // 2, room[1] // 2) if is_centered else (0, 0)
        return Letterbox(image_px, input_px, inner, offset)

    def canvas(self, image: np.ndarray) -> np.ndarray:
        """Return the input [h, w, 3] uint8 for an image [H, W, 3] uint8."""
        width, height = self.input_px
        canvas = np.full((height, width, 3), PADDING, np.uint8)
        (left, top), (inner_width, inner_height) = self.offset_px, self.inner_px
        inner = cv2.resize(image, self.inner_px, interpolation=cv2.INTER_LINEAR)
        canvas[top : top + inner_height, left : left + inner_width] = inner
        return canvas

    def to_image(self, boxes: np.ndarray) -> np.ndarray:
        """Convert boxes from the input to the image, and clip them to the image.

        Networks have the origin at the corner of the first pixel. This project has the origin at
        the center of this pixel. So x_image = (x_input - offset) * W / w - 0.5. Here, W is the
        width of the image; w is the width and offset the left edge of the scaled image. The image
        covers -0.5 to W - 0.5.

        Args:
            boxes: Boxes in the input, [M, 4], x0 y0 x1 y1, pixels.

        Returns:
            Boxes in the image, [M, 4], x0 y0 x1 y1, pixels.
        """
        scale = np.divide(self.image_px, self.inner_px)
        corners = (boxes.reshape(-1, 2, 2) - self.offset_px) * scale
        return (np.clip(corners, 0, self.image_px) - 0.5).reshape(-1, 4)
