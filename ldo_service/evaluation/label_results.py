"""What is told of the labels of a run: rows of figures, values for JSON, the sheet of pictures."""

from typing import Any

import numpy as np

from ldo_service.geometry.sequence import Sequence

from .finished_run import FinishedRun
from .label_sheet import LabelPicture, label_sheet
from .open_names import Found
from .segmentation import class_ious
from .semantics import GATES, LabelErrors, LabelView, ListErrors, labelled_maps
from .sheet import VIEWS

FEWEST_OBJECTS = 0.02  # of the pixels of a frame that is shown
FIGURES = ("mean_iou", "object_iou", "weighted_iou", "mean_accuracy", "pixel_accuracy")


def sheet_of_labels(
    run: FinishedRun, sequence: Sequence, errors: LabelErrors, threads: int = 1
) -> np.ndarray | None:
    """Of some frames, the best and the worst included; None where no frame has an object."""
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
    """Frames in their order, each with what stands above it: spread by how much of their objects is
    right, from the worst to the best. In all of them some percent of the pixels are objects."""
    shares = {}
    for frame, counts in zip(errors.frames, errors.confusions, strict=True):
        objects = counts.sum() - counts[0, 0]  # that there are, or that are shown
        if objects > FEWEST_OBJECTS * counts.sum():
            shares[frame] = float(np.diag(counts)[1:].sum() / objects)
    ranked = sorted(shares, key=lambda frame: (shares[frame], frame))
    places = np.unique(np.round(np.linspace(0, len(ranked) - 1, count)).astype(int))
    chosen = sorted(ranked[place] for place in places) if ranked else []
    notes = {ranked[0]: ", the worst", ranked[-1]: ", the best"} if len(ranked) > 1 else {}
    return [(f, f"frame {f}: {shares[f]:.0%} right{notes.get(f, '')}") for f in chosen]


def plain_labels(errors: LabelErrors) -> dict[str, Any]:
    """For JSON; what is no finite number is null."""
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
    }


def _plain_figures(row: ListErrors, gate: float) -> dict[str, Any]:
    figures = row.figures(gate)
    plain = {name: finite(getattr(figures, name)) for name in FIGURES}
    return {"classes": figures.classes, **plain}


def _plain(found: Found) -> dict[str, Any]:
    return {
        "right": found.right,
        "wanted": found.wanted,
        "named": found.named,
        "recall": finite(found.recall),
        "precision": finite(found.precision),
    }


def finite(value: float | None) -> float | None:
    return value if value is not None and np.isfinite(value) else None
