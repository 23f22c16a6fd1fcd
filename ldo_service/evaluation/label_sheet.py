"""What the map says things are beside what they truly are, for the eye."""

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ldo_service.detection.vocabulary import COCO

from .label_lists import UNKNOWN, VOID, LabelList, full_list
from .pictures import Color, contact_sheet, legend
from .semantics import LabelView
from .sheet import shrunk

CAPTIONS = ["camera", "truth", "map", "error"]
PAINT = 0.65  # of a label's colour over the camera's image in grey
GOLDEN_RATIO = 0.618033988749895
SHADES = ((0.95, 1.0), (0.55, 1.0), (0.85, 0.65))  # saturation, value
VOID_COLOR, UNKNOWN_COLOR = (0, 0, 0), (255, 255, 255)
RIGHT, MISSED, BEYOND = (46, 160, 67), (31, 111, 235), (178, 205, 245)
INVENTED, CONFUSED = (207, 34, 46), (240, 190, 30)
ERRORS = {
    "right object": RIGHT,
    "missed": MISSED,
    "missed, COCO has no class for it": BEYOND,
    "invented": INVENTED,
    "another object": CONFUSED,
}


@dataclass(frozen=True, eq=False, slots=True)
class LabelPicture:
    """A view, and what stands above its row."""

    label: str
    view: LabelView


def label_sheet(
    pictures: list[LabelPicture], map_names: Sequence[str], class_names: Sequence[str]
) -> np.ndarray:
    """Rows [camera, truth, map, error] as uint8 RGB, and a legend of the names that occur.

    Names are those of the full list (`label_lists.full_list`); background is the camera's image in
    grey. Raises ValueError without any row.
    """
    labels = full_list(class_names)
    of_truth, of_map = labels.of_truth(class_names), labels.of_map(map_names)
    views = [
        (p.view.frame.color, of_truth[p.view.truth.class_ids], of_map[p.view.shown])
        for p in pictures
    ]
    seen = sorted({k for _, *both in views for image in both for k in np.unique(image).tolist()})
    colors = label_colors([k for k in seen if 0 < k < UNKNOWN])
    rows = [list(map(shrunk, _pictures(*view, labels, colors))) for view in views]
    sheet = contact_sheet(rows, CAPTIONS, [picture.label for picture in pictures])
    names = {**dict(enumerate(labels.names)), UNKNOWN: "not in the list", VOID: "truth unknown"}
    entries = [(names[k], _color(colors[k])) for k in seen if k > 0]
    strips = legend(entries, sheet.shape[1]), legend(list(ERRORS.items()), sheet.shape[1])
    return np.vstack([sheet, *strips])


def _pictures(
    color: np.ndarray, truth: np.ndarray, shown: np.ndarray, labels: LabelList, colors: np.ndarray
) -> list[np.ndarray]:
    return [
        color,
        painted(color, truth, colors),
        painted(color, shown, colors),
        error_colors(color, truth, shown, labels),
    ]


def label_colors(indices: Sequence[int]) -> np.ndarray:
    """[256, 3] uint8 for some indices: hues in steps of the golden ratio, three shades of them."""
    colors = np.zeros((256, 3), np.uint8)
    for place, index in enumerate(indices):
        hue, shade = place * GOLDEN_RATIO % 1.0, place % len(SHADES)
        colors[index] = np.round(255 * np.array(colorsys.hsv_to_rgb(hue, *SHADES[shade])))
    colors[VOID], colors[UNKNOWN] = VOID_COLOR, UNKNOWN_COLOR
    return colors


def painted(color: np.ndarray, labels: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """[H, W, 3] uint8, each object in its colour."""
    grey = _grey(color)
    mixed = (1 - PAINT) * grey + PAINT * colors[labels]
    return np.where(labels[..., None] > 0, np.round(mixed), grey).astype(np.uint8)


def error_colors(
    color: np.ndarray, truth: np.ndarray, shown: np.ndarray, labels: LabelList
) -> np.ndarray:
    """[H, W, 3] uint8, by `ERRORS`; grey where both are background or truth does not count."""
    is_object, is_shown = truth > 0, shown > 0
    picture = _grey(color).astype(np.uint8)
    has_class = np.isin(truth, [k for k, name in enumerate(labels.names) if name in COCO])
    picture[is_object & ~is_shown] = BEYOND
    picture[has_class & ~is_shown] = MISSED
    picture[~is_object & is_shown] = INVENTED
    picture[is_object & is_shown & (truth != shown)] = CONFUSED
    picture[is_object & (truth == shown)] = RIGHT
    picture[truth == VOID] = VOID_COLOR
    return picture


def _grey(color: np.ndarray) -> np.ndarray:
    """Bright, so that colours stand out."""
    grey = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)[..., None].astype(np.float32)
    return np.repeat(np.round(96 + 0.5 * grey), 3, axis=2)


def _color(rgb: np.ndarray) -> Color:
    red, green, blue = rgb.tolist()
    return red, green, blue
