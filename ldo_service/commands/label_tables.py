"""Tables of how well the labels of maps agree with the truth."""

from math import isfinite

from rich.table import Table

from ldo_service.evaluation.open_names import Found
from ldo_service.evaluation.semantics import GATES, LabelErrors

FIGURES = {
    "mIoU": "mean_iou",
    "objects": "object_iou",
    "by frequency": "weighted_iou",
    "accuracy": "mean_accuracy",
    "pixels": "pixel_accuracy",
}


def label_table(rows: list[LabelErrors]) -> Table:
    """A line for each list of names, and for each share of the pixels that a class must have."""
    table = Table("map", "names", "classes", *FIGURES, "per image", "frames")
    for row in rows:
        for errors in row.lists:
            for gate, share in GATES.items():
                figures = errors.figures(share)
                cells = [_percent(getattr(figures, figure)) for figure in FIGURES.values()]
                is_all = share == 0
                cells.append(_percent(errors.per_image_iou()) if is_all else "")
                names = f"{errors.labels.name}, {gate}"
                table.add_row(row.map, names, str(figures.classes), *cells, str(len(errors.frames)))
    return table


def open_table(rows: list[LabelErrors], calls_per_frame: float | None) -> Table:
    """Agreement of views, names beyond COCO, and how often somebody was asked for one."""
    columns = ("map", "consistency", "beyond COCO: recall", "precision", "VLM calls per frame")
    table = Table(*columns)
    for row in rows:
        calls = "not counted" if calls_per_frame is None else f"{calls_per_frame:.3f}"
        agreed = f"{_number(row.consistency.share)}, {row.pairs} pairs"
        table.add_row(row.map, agreed, *_shares(row.objects, "objects"), calls)
        table.add_row("", "", *_shares(row.pixels, "pixels"), "")
    return table


def _shares(found: Found, what: str) -> tuple[str, str]:
    return (
        f"{_percent(found.recall)} of {found.wanted:,} {what}",
        f"{_percent(found.precision)} of {found.named:,}",
    )


def _percent(value: float) -> str:
    return f"{value:.1%}" if isfinite(value) else "-"


def _number(value: float) -> str:
    return f"{value:.3f}" if isfinite(value) else "-"
