"""Output of the label evaluation: a contact sheet of chosen frames, and values for JSON."""

import colorsys
from collections import abc
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ldo_service.detection.vocabulary import COCO
from ldo_service.geometry.sequence import Sequence

from .finished_run import FinishedRun
from .instances import InstancePrecision, mean_precision
from .label_lists import UNKNOWN, VOID, LabelSet, full_list
from .label_measures import DetectionCounts, class_ious
from .pictures import Color, contact_sheet, legend
from .semantics import GATES, LabelErrors, LabelView, ListErrors, labelled_maps
from .sheet import VIEWS, shrunk

CAPTIONS = ["camera", "truth", "map", "error"]
PAINT = 0.65  # Opacity of a label's color over the gray camera image.
GOLDEN_RATIO = 0.618033988749895
SHADES = ((0.95, 1.0), (0.55, 1.0), (0.85, 0.65))  # Saturation and value, 0..1, of each shade.
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

MIN_OBJECTS = 0.02  # Minimum fraction of object pixels in a frame of the sheet.
FIGURES = ("mean_iou", "object_iou", "weighted_iou", "mean_accuracy", "pixel_accuracy")


@dataclass(frozen=True, eq=False, slots=True)
class LabelPicture:
    """One row of the contact sheet: a labelled view, and the text above it."""

    label: str
    view: LabelView


def label_sheet(
    pictures: list[LabelPicture], map_names: abc.Sequence[str], class_names: abc.Sequence[str]
) -> np.ndarray:
    """Draw a row [camera, truth, map, error] per picture, and a legend of the names that occur.

    Background pixels show the camera image in gray.

    Args:
        pictures: Views to draw.
        map_names: Names of the map's labels, by label.
        class_names: Names of the data set's classes, by class id. The legend shows each name as
            in `label_lists.full_list(class_names)`.

    Returns:
        The sheet, RGB [H, W, 3] uint8.

    Raises:
        ValueError: If there is no picture.
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
    color: np.ndarray, truth: np.ndarray, shown: np.ndarray, labels: LabelSet, colors: np.ndarray
) -> list[np.ndarray]:
    return [
        color,
        painted(color, truth, colors),
        painted(color, shown, colors),
        error_colors(color, truth, shown, labels),
    ]


def label_colors(indices: abc.Sequence[int]) -> np.ndarray:
    """Return a color table [256, 3] uint8 with different colors for the given label indices.

    From one index to the next, the hue advances by the golden ratio of a full turn, and the shade
    advances by one entry of `SHADES`.
    """
    colors = np.zeros((256, 3), np.uint8)
    for place, index in enumerate(indices):
        hue, shade = place * GOLDEN_RATIO % 1.0, place % len(SHADES)
        colors[index] = np.round(255 * np.array(colorsys.hsv_to_rgb(hue, *SHADES[shade])))
    colors[VOID], colors[UNKNOWN] = VOID_COLOR, UNKNOWN_COLOR
    return colors


def painted(color: np.ndarray, labels: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """Draw the objects of a label image over the gray camera image.

    Args:
        color: Camera image, RGB [H, W, 3] uint8.
        labels: Label indices, [H, W] uint8; 0 is background and stays gray.
        colors: Color of each label, [256, 3] uint8.

    Returns:
        The picture, RGB [H, W, 3] uint8.
    """
    gray = _gray(color)
    mixed = (1 - PAINT) * gray + PAINT * colors[labels]
    return np.where(labels[..., None] > 0, np.round(mixed), gray).astype(np.uint8)


def error_colors(
    color: np.ndarray, truth: np.ndarray, shown: np.ndarray, labels: LabelSet
) -> np.ndarray:
    """Draw each kind of label error in its own color; `ERRORS` lists the kinds and their colors.

    Pixels are gray where both label images have background, and black where the ground truth is
    void.

    Args:
        color: Camera image, RGB [H, W, 3] uint8.
        truth: Indices of the true names in `labels`, [H, W] uint8.
        shown: Indices of the map's names in `labels`, [H, W] uint8.
        labels: List of label names to which the indices refer.

    Returns:
        The picture, RGB [H, W, 3] uint8.
    """
    is_object, is_shown = truth > 0, shown > 0
    picture = _gray(color).astype(np.uint8)
    has_class = np.isin(truth, [k for k, name in enumerate(labels.names) if name in COCO])
    picture[is_object & ~is_shown] = BEYOND
    picture[has_class & ~is_shown] = MISSED
    picture[~is_object & is_shown] = INVENTED
    picture[is_object & is_shown & (truth != shown)] = CONFUSED
    picture[is_object & (truth == shown)] = RIGHT
    picture[truth == VOID] = VOID_COLOR
    return picture


def _gray(color: np.ndarray) -> np.ndarray:
    """Return the image in light gray, so that colors stand out."""
    gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)[..., None].astype(np.float32)
    return np.repeat(np.round(96 + 0.5 * gray), 3, axis=2)


def _color(rgb: np.ndarray) -> Color:
    red, green, blue = rgb.tolist()
    return red, green, blue


def sheet_of_labels(
    run: FinishedRun, sequence: Sequence, errors: LabelErrors, threads: int = 1
) -> np.ndarray | None:
    """Draw the contact sheet of some frames, including the frames with most and fewest errors.

    Returns:
        The sheet, RGB [H, W, 3] uint8. None if the source has no true labels, or if no frame has
        enough object pixels.
    """
    truth = sequence.true_labels()
    chosen = frames_to_show(errors.lists[0])
    if truth is None or not chosen:
        return None
    map_ = next(m for m in labelled_maps(sequence, run, threads) if m.name == errors.map)
    pictures = [
        LabelPicture(
            note, LabelView(sequence[index], truth.frame(index), map_.image(run.frame(index)))
        )
        for index, note in chosen
    ]
    return label_sheet(pictures, map_.names, truth.class_names)


def frames_to_show(errors: ListErrors, count: int = VIEWS) -> list[tuple[int, str]]:
    """Choose frames with objects for the contact sheet, spread from the worst to the best.

    Frames are ranked by the fraction of their object pixels that have the right label. A frame is
    a candidate only if more than the fraction MIN_OBJECTS of its pixels are object pixels.

    Args:
        errors: Label errors for one list of names; the ranking uses these errors.
        count: Number of frames.

    Returns:
        Index of each frame and the text above it on the contact sheet, ascending by index.
    """
    shares = {}
    for frame, counts in zip(errors.frames, errors.confusions, strict=True):
        objects = counts.sum() - counts[0, 0]  # Object pixels in the ground truth or the map.
        if objects > MIN_OBJECTS * counts.sum():
            shares[frame] = float(np.diag(counts)[1:].sum() / objects)
    ranked = sorted(shares, key=lambda frame: (shares[frame], frame))
    places = np.unique(np.round(np.linspace(0, len(ranked) - 1, count)).astype(int))
    chosen = sorted(ranked[place] for place in places) if ranked else []
    notes = {ranked[0]: ", the worst", ranked[-1]: ", the best"} if len(ranked) > 1 else {}
    return [(f, f"frame {f}: {shares[f]:.0%} right{notes.get(f, '')}") for f in chosen]


def plain_labels(errors: LabelErrors) -> dict[str, Any]:
    """Return the label errors as values for JSON; numbers that are not finite become null."""
    return {
        "map": errors.map,
        "frames": list(errors.lists[0].frames),
        "lists": {row.labels.name: _plain_list(row) for row in errors.lists},
        "consistency": finite(errors.consistency.share),
        "consistency_pairs": errors.pairs,
        "beyond_coco": {"objects": _plain(errors.objects), "pixels": _plain(errors.pixels)},
    }


def _plain_list(row: ListErrors) -> dict[str, Any]:
    counts, ious = row.pooled, class_ious(row.pooled)
    true = counts.sum(axis=1)
    return {
        **{gate: _plain_figures(row, share) for gate, share in GATES.items()},
        "per_image_iou": finite(row.per_image_iou()),
        "classes": {
            name: {"pixels": int(true[k]), "iou": finite(float(ious[k]))}
            for k, name in enumerate(row.labels.names)
            if true[k]
        },
        "instances": None if row.instances is None else _plain_instances(row.instances),
    }


def _plain_instances(by_class: dict[str, InstancePrecision]) -> dict[str, Any]:
    return {
        **_plain_precision(mean_precision(by_class)),
        "classes": {name: _plain_precision(one) for name, one in by_class.items()},
    }


def _plain_precision(one: InstancePrecision) -> dict[str, float | None]:
    return {name: finite(getattr(one, name)) for name in ("ap", "ap50", "ap25")}


def _plain_figures(row: ListErrors, gate: float) -> dict[str, Any]:
    figures = row.figures(gate)
    plain = {name: finite(getattr(figures, name)) for name in FIGURES}
    return {"classes": figures.classes, **plain}


def _plain(found: DetectionCounts) -> dict[str, Any]:
    return {
        "right": found.right,
        "wanted": found.wanted,
        "named": found.named,
        "recall": finite(found.recall),
        "precision": finite(found.precision),
    }


def finite(value: float | None) -> float | None:
    """Return the value, or None if it is not finite."""
    return value if value is not None and np.isfinite(value) else None
