"""Input and output of networks of the YOLO family.

The networks predict boxes in the cells of grids over the input, one grid for each stride. The
number of boxes therefore determines the layout of the output. As a check, the predicted boxes must
lie near their cells.

            in                             out
    yolov5  RGB 0..1, centered             [1, 3 cells, 5 + C] cx, cy, w, h, objectness, classes
    yolox   BGR 0..255, upper left corner  [1, cells, 5 + C] the same, as offsets and log sizes
    yolov8  RGB 0..1, centered             [1, 4 + C, cells] cx, cy, w, h, classes

YOLOX may also come with decoded boxes (`--decode_in_inference`). YOLOv7 has the layout of YOLOv5;
YOLOv9 and YOLO11 have that of YOLOv8.

Images are scaled into the input of a network (letterbox), and boxes are scaled back. Of overlapping
boxes of one class, non-maximum suppression keeps the one with the highest score.
"""

from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from ldo_service.errors import ConfigError, ModelError

# Strides of known exports; a network uses some that follow each other.
STRIDES_PX = (4, 8, 16, 32, 64)
# Maximum median distance of a box center from its cell, in cells; distances to sides reach 16.
CELLS_APART = 8
SCORE_TOLERANCE = 1e-3  # Tolerance of scores beyond 0..1 for rounding.
EXPECTED = (
    "[1, N, 5 + C] with three boxes a cell (yolov5) or one (yolox), or [1, 4 + C, N] (yolov8), "
    "over grids of strides 8, 16 and 32 pixels or the like, exported without suppression of "
    "overlapping boxes"
)

PADDING = 114  # Gray value that the YOLO family is trained with.


@dataclass(frozen=True, slots=True)
class Layout:
    """Input and output of one kind of network."""

    name: str
    boxes_per_cell: int
    has_objectness: bool
    is_channels_first: bool  # The output is [1, channels, N].
    is_centered: bool  # The image is centered in the input.
    is_rgb: bool  # The colors are RGB; false: BGR.
    value_scale: float  # Factor of pixels in 0..255.


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
        corners_px: Upper left corners of the cells, [N, 2], pixels of the input.
        strides_px: Sides of the cells, [N, 1], pixels of the input.
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

    boxes: np.ndarray  # [M, 4] x0, y0, x1, y1, pixels of the input from its corner.
    scores: np.ndarray  # [M] 0..1.
    class_ids: np.ndarray  # [M], index into the classes.


@dataclass(frozen=True, slots=True)
class Head:
    """Layout of the output of one network."""

    layout: Layout
    class_count: int
    grid: Grid | None  # Grid of the boxes; if unknown, they are not checked.
    is_decoded: bool  # False: boxes are offsets to their cells and log sizes.

    def candidates(self, output: np.ndarray, score_min: float) -> Candidates:
        """Return the boxes of an output whose best class has at least the score `score_min`.

        The score is the product of objectness and class score. In layouts without objectness, it is
        the class score.
        """
        rows = _rows(output, self.layout)
        scores = self._scores(rows)  # One column excludes most boxes.
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
                f"with the layout {self.layout.name}, scores of {low:.3g} to {high:.3g} are no "
                "probabilities: export the network with its last sigmoid."
            )
        if self.cells_apart(output) > CELLS_APART:
            raise ModelError(
                f"with the layout {self.layout.name}, boxes lie {self.cells_apart(output):.0f} "
                f"grid cells from the cells that predict them, expected at most {CELLS_APART:g}: "
                "export the network with boxes in pixels."
            )

    def cells_apart(self, output: np.ndarray) -> float:
        """Return the median distance of boxes from their cells, in cells; 0 if unknown."""
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
    """Determine the layout of a network's output.

    Args:
        output: The only output of the network, for one image.
        input_px: Width and height of the network's input.
        wanted: Name of the layout; empty: determine it from the shape of the output.

    Raises:
        ModelError: If the output has no known layout, or not the wanted one.
    """
    if output.ndim != 3 or output.shape[0] != 1 or output.dtype != np.float32:
        raise ModelError(
            f"its output is {output.dtype} {list(output.shape)}. Expected: float32 {EXPECTED}."
        )
    layout = layout_named(wanted) if wanted else _layout_of(output, input_px)
    boxes, channels = _rows(output, layout).shape
    class_count = channels - (5 if layout.has_objectness else 4)
    grid = find_grid(boxes, input_px)
    boxes_per_cell = grid.boxes_per_cell if grid else layout.boxes_per_cell
    is_without_cells = layout.name == "yolox" and grid is None
    if class_count < 1 or boxes_per_cell != layout.boxes_per_cell or is_without_cells:
        raise ModelError(
            f"its output {list(output.shape)} for an input of {input_px[0]}x{input_px[1]} pixels "
            f"is not that of {layout.name}. Expected: {EXPECTED}."
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
        raise ConfigError(f"there is no layout {name!r}. The layouts are {', '.join(LAYOUTS)}.")
    return LAYOUTS[name]


def find_grid(count: int, input_px: tuple[int, int]) -> Grid | None:
    """Return the grid for a network that predicts `count` boxes, or None if there is none.

    Grids have consecutive strides and one or three boxes per cell. Boxes are sorted by stride, the
    finest first. With three per cell, the grid is repeated three times. No two grids of an input
    have the same count.
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
    """Return the grid of these strides."""
    corners: list[np.ndarray] = []
    for stride in strides:
        columns, rows = input_px[0] // stride, input_px[1] // stride
        cells = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
        corners.append(np.tile(cells.reshape(-1, 2) * stride, (boxes_per_cell, 1)))
    sides = np.repeat(strides, [len(part) for part in corners])[:, None]
    return Grid(np.concatenate(corners), sides, boxes_per_cell)


def _layout_of(output: np.ndarray, input_px: tuple[int, int]) -> Layout:
    """Return the layout whose box axis in this output has the length of a possible grid."""
    for layout in LAYOUTS.values():
        grid = find_grid(len(_rows(output, layout)), input_px)
        if grid is not None and grid.boxes_per_cell == layout.boxes_per_cell:
            return layout
    raise ModelError(
        f"its output {list(output.shape)} for an input of {input_px[0]}x{input_px[1]} pixels is "
        f"of no known layout. Expected: {EXPECTED}."
    )


def _rows(output: np.ndarray, layout: Layout) -> np.ndarray:
    """Return the boxes as rows, [N, channels]."""
    return output[0].T if layout.is_channels_first else output[0]


def _corners(boxes: np.ndarray) -> np.ndarray:
    """Return x0, y0, x1, y1 of cx, cy, w, h, [M, 4]."""
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
        """Return the placement in the center (YOLOv5) or in the upper left corner (YOLOX)."""
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
        """Return boxes [M, 4] of the input in pixels of the image, clipped to it.

        Boxes are x0, y0, x1, y1. Networks place the origin at the corner of the first pixel; this
        project places it at the pixel's center. So x_image = (x_input - offset) * W / w - 0.5, and
        the image covers -0.5 to W - 0.5.
        """
        scale = np.divide(self.image_px, self.inner_px)
        corners = (boxes.reshape(-1, 2, 2) - self.offset_px) * scale
        return (np.clip(corners, 0, self.image_px) - 0.5).reshape(-1, 4)
