"""How the YOLO family writes boxes: what goes in, and what the numbers that come out mean.

Every box belongs to a cell of a grid over the input, one grid for each stride. So the number of
boxes tells the layout, and boxes that lie near their cells tell that it was understood.

            in                             out
    yolov5  RGB 0..1, centred              [1, 3 cells, 5 + C] cx, cy, w, h, objectness, classes
    yolox   BGR 0..255, upper left corner  [1, cells, 5 + C] the same, as offsets and log sizes
    yolov8  RGB 0..1, centred              [1, 4 + C, cells] cx, cy, w, h, classes

YOLOX may also come with its boxes decoded (`--decode_in_inference`); YOLOv7 writes as YOLOv5,
YOLOv9 and YOLO11 as YOLOv8.

Images are scaled into the input of a network (letterbox), and boxes are scaled back. Of overlapping
boxes of one class, non-maximum suppression keeps the most certain.
"""

from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from ldo_service.errors import ConfigError, ModelError

STRIDES_PX = (4, 8, 16, 32, 64)  # of one grid, of the exports there are
CELLS_APART = 8  # a box's centre from its cell, in the median; distances to sides go up to 16
SCORE_TOLERANCE = 1e-3  # of rounding, beyond 0..1
EXPECTED = (
    "[1, N, 5 + C] with three boxes a cell (yolov5) or one (yolox), or [1, 4 + C, N] (yolov8), "
    "over grids of strides 8, 16 and 32 pixels or the like, exported without suppression of "
    "overlapping boxes"
)

PADDING = 114  # the grey that the YOLO family is trained with


@dataclass(frozen=True, slots=True)
class Layout:
    name: str
    boxes_per_cell: int
    has_objectness: bool
    is_channels_first: bool  # [1, channels, N]
    is_centered: bool  # the image in the input
    is_rgb: bool  # else BGR
    value_scale: float  # of pixels 0..255


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
    """The cell of each box: its upper left corner [N, 2] and its side [N, 1] in pixels of the
    input."""

    corners_px: np.ndarray
    strides_px: np.ndarray
    boxes_per_cell: int

    def cells_apart(self, centers_px: np.ndarray) -> float:
        """Distance of boxes [N, 2] from the middles of their cells, in cells, in the median."""
        middles_px = self.corners_px + self.strides_px / 2
        return float(np.median(np.abs(centers_px - middles_px) / self.strides_px))


@dataclass(frozen=True, slots=True)
class Candidates:
    """Boxes before suppression."""

    boxes: np.ndarray  # [M, 4] x0, y0, x1, y1 in pixels of the input, from its corner
    scores: np.ndarray  # [M] 0..1
    class_ids: np.ndarray  # [M]


@dataclass(frozen=True, slots=True)
class Head:
    """The output of one network, understood."""

    layout: Layout
    class_count: int
    grid: Grid | None  # None: of no known form, and nothing can be said of where boxes lie
    is_decoded: bool  # else boxes are offsets to their cells, and log sizes

    def candidates(self, output: np.ndarray, score_min: float) -> Candidates:
        """The boxes of an output whose best class has at least this score.

        score = objectness * class, or the class alone where there is no objectness.
        """
        rows = _rows(output, self.layout)
        scores = self._scores(rows)  # of a single column first: most boxes end here
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
        """Raises ModelError when scores are no probabilities or boxes lie far from their cells."""
        scores = _rows(output, self.layout)[:, 4:]
        low, high = float(scores.min()), float(scores.max())
        if low < -SCORE_TOLERANCE or high > 1 + SCORE_TOLERANCE:
            raise ModelError(
                f"read as {self.layout.name}, scores of {low:.3g} to {high:.3g} are no "
                "probabilities: export the network with its last sigmoid."
            )
        if self.cells_apart(output) > CELLS_APART:
            raise ModelError(
                f"read as {self.layout.name}, boxes lie {self.cells_apart(output):.0f} cells from "
                "where they belong: export the network with boxes in pixels."
            )

    def cells_apart(self, output: np.ndarray) -> float:
        """How far boxes are from where they belong; 0 where that is not known."""
        if self.grid is None:
            return 0.0
        rows = _rows(output, self.layout)
        return self.grid.cells_apart(self._decoded(rows, np.arange(len(rows)))[:, :2])

    @property
    def _first_class(self) -> int:
        return 5 if self.layout.has_objectness else 4

    def _scores(self, rows: np.ndarray) -> np.ndarray:
        """[N] at least the score of each box."""
        return rows[:, 4] if self.layout.has_objectness else rows[:, 4:].max(axis=1)

    def _decoded(self, rows: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """cx, cy, w, h [M, 4] in pixels of the chosen ones."""
        boxes = rows[chosen, :4].astype(np.float64)
        if self.is_decoded or self.grid is None:
            return boxes
        corners, strides = self.grid.corners_px[chosen], self.grid.strides_px[chosen]
        with np.errstate(over="ignore"):  # an absurd size is clipped to the image
            return np.hstack((corners + boxes[:, :2] * strides, np.exp(boxes[:, 2:]) * strides))


def detect_layout(output: np.ndarray, input_px: tuple[int, int], wanted: str = "") -> Head:
    """What an output of the network means.

    output    what it makes of an image, all outputs but this one being absent
    input_px  width and height of its input
    wanted    name of the layout; empty: the one that the shape tells

    Raises ModelError when it is none of the layouts, or not the wanted one.
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
    if name not in LAYOUTS:
        raise ConfigError(f"there is no layout {name!r}. The layouts are {', '.join(LAYOUTS)}.")
    return LAYOUTS[name]


def find_grid(count: int, input_px: tuple[int, int]) -> Grid | None:
    """The grid that has so many boxes: strides that follow each other, one or three boxes a cell.

    Boxes come stride by stride from the finest; with three a cell, each of the three as a whole
    grid. No two grids of an input have the same count.
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
    corners: list[np.ndarray] = []
    for stride in strides:
        columns, rows = input_px[0] // stride, input_px[1] // stride
        cells = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
        corners.append(np.tile(cells.reshape(-1, 2) * stride, (boxes_per_cell, 1)))
    sides = np.repeat(strides, [len(part) for part in corners])[:, None]
    return Grid(np.concatenate(corners), sides, boxes_per_cell)


def _layout_of(output: np.ndarray, input_px: tuple[int, int]) -> Layout:
    """By which side has as many boxes as a grid."""
    for layout in LAYOUTS.values():
        grid = find_grid(len(_rows(output, layout)), input_px)
        if grid is not None and grid.boxes_per_cell == layout.boxes_per_cell:
            return layout
    raise ModelError(
        f"its output {list(output.shape)} for an input of {input_px[0]}x{input_px[1]} pixels is "
        f"none that is known. Expected: {EXPECTED}."
    )


def _rows(output: np.ndarray, layout: Layout) -> np.ndarray:
    """[N, channels]"""
    return output[0].T if layout.is_channels_first else output[0]


def _corners(boxes: np.ndarray) -> np.ndarray:
    """x0, y0, x1, y1 of cx, cy, w, h [M, 4]."""
    halves = boxes[:, 2:] / 2
    return np.hstack((boxes[:, :2] - halves, boxes[:, :2] + halves))


@dataclass(frozen=True, slots=True)
class Letterbox:
    """Where in the input of a network the image lies: all of it, in proportion, on grey.

    image_px   width, height of the image
    input_px   width, height of the network's input
    inner_px   width, height of the scaled image
    offset_px  of the scaled image's upper left corner in the input
    """

    image_px: tuple[int, int]
    input_px: tuple[int, int]
    inner_px: tuple[int, int]
    offset_px: tuple[int, int]

    @staticmethod
    def fit(image_px: tuple[int, int], input_px: tuple[int, int], is_centered: bool) -> "Letterbox":
        """Centred as YOLOv5 has it, or in the upper left corner as YOLOX does."""
        scale = min(input_px[0] / image_px[0], input_px[1] / image_px[1])
        inner = max(1, round(image_px[0] * scale)), max(1, round(image_px[1] * scale))
        room = input_px[0] - inner[0], input_px[1] - inner[1]
        offset = (room[0] // 2, room[1] // 2) if is_centered else (0, 0)
        return Letterbox(image_px, input_px, inner, offset)

    def canvas(self, image: np.ndarray) -> np.ndarray:
        """The input [h, w, 3] uint8 for an image [H, W, 3] uint8."""
        width, height = self.input_px
        canvas = np.full((height, width, 3), PADDING, np.uint8)
        (left, top), (inner_width, inner_height) = self.offset_px, self.inner_px
        inner = cv2.resize(image, self.inner_px, interpolation=cv2.INTER_LINEAR)
        canvas[top : top + inner_height, left : left + inner_width] = inner
        return canvas

    def to_image(self, boxes: np.ndarray) -> np.ndarray:
        """Boxes [M, 4] (x0, y0, x1, y1) of the input in pixels of the image, clipped to it.

        Networks count from the corner of the first pixel, this project from its centre:
        x_image = (x_input - offset) * W / w - 0.5, so that the image covers -0.5 .. W - 0.5.
        """
        scale = np.divide(self.image_px, self.inner_px)
        corners = (boxes.reshape(-1, 2, 2) - self.offset_px) * scale
        return (np.clip(corners, 0, self.image_px) - 0.5).reshape(-1, 4)
