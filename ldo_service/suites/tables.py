"""Outcomes of a suite as tables in Markdown."""

from collections.abc import Sequence
from statistics import mean, stdev

import msgspec

from .runner import Outcome
from .suite import FIGURES, OF_LPIPS, Score, Suite

AVERAGE = "average"
Cells = dict[str, str]  # Texts by column.
NO_LPIPS = "LPIPS is not computed; `--lpips FILE.onnx` adds it."


def markdown(suite: Suite, outcomes: Sequence[Outcome], *, has_lpips: bool = False) -> str:
    """Return the outcomes of a suite as tables in Markdown.

    If the suite has one sequence, one table shows all metrics. Otherwise there is one table for
    each metric, with a column for each sequence. A cell has the mean over the seeds, and with
    several seeds the standard deviation. The first rows are published values. A line under each
    table names the variants whose runs had neither a detector nor a labeller.

    Args:
        suite: The suite.
        outcomes: Outcomes of all its runs.
        has_lpips: False to leave out LPIPS, because no network computed it.
    """
    parts, note = [f"# {suite.title}", suite.about.strip()], _unlabelled(suite, outcomes)
    if not has_lpips and OF_LPIPS.intersection(suite.figures):
        parts.append(NO_LPIPS)
        others = tuple(name for name in suite.figures if name not in OF_LPIPS)
        suite = msgspec.structs.replace(suite, figures=others)
    if len(suite.sequences) == 1:
        parts += [_of_one_sequence(suite, outcomes), note]
    else:
        for name in suite.figures:
            parts += [_of_one_figure(suite, name, outcomes), note]
    return "\n\n".join(part for part in parts if part) + "\n"


def _unlabelled(suite: Suite, outcomes: Sequence[Outcome]) -> str:
    """Return a line that names the variants without detector and labeller; empty if all had one."""
    variants = [
        variant
        for variant in suite.variants
        if any(
            o.evaluated is not None and not o.evaluated.is_labelled
            for o in outcomes
            if o.entry.variant == variant
        )
    ]
    if not variants:
        return ""
    return f"{', '.join(variants)}: without a detector and a labeller; the maps have no labels."


def _of_one_sequence(suite: Suite, outcomes: Sequence[Outcome]) -> str:
    (sequence,) = suite.sequences
    rows: dict[str, Cells] = {}
    for method, printed in suite.published.items():
        known = printed.get(sequence, {})
        rows[method] = {
            name: f"{known[name]:{FIGURES[name].form}}" for name in suite.figures if name in known
        }
    for variant in suite.variants:
        here = [o for o in outcomes if o.entry.variant == variant]
        rows[variant] = {name: _cell(FIGURES[name], here) for name in suite.figures}
    return _table(sequence, {name: FIGURES[name].title for name in suite.figures}, rows)


def _of_one_figure(suite: Suite, name: str, outcomes: Sequence[Outcome]) -> str:
    figure, rows = FIGURES[name], dict[str, Cells]()
    for method, printed in suite.published.items():
        known = {sequence: f[name] for sequence, f in printed.items() if name in f}
        rows[method] = {sequence: f"{value:{figure.form}}" for sequence, value in known.items()}
    for variant in suite.variants:
        here = [o for o in outcomes if o.entry.variant == variant]
        rows[variant] = {
            sequence: _cell(figure, [o for o in here if o.entry.sequence == sequence])
            for sequence in suite.sequences
        } | {AVERAGE: _average(suite, figure, here)}
    columns = {sequence: sequence for sequence in (*suite.sequences, AVERAGE)}
    return _table(figure.title, columns, {method: cells for method, cells in rows.items() if cells})


def _table(corner: str, columns: dict[str, str], rows: dict[str, Cells]) -> str:
    lines = [[corner, *columns.values()], ["---"] * (1 + len(columns))]
    lines += [[row, *(cells.get(column, "") for column in columns)] for row, cells in rows.items()]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _cell(figure: Score, outcomes: Sequence[Outcome]) -> str:
    values = _values(figure, outcomes)
    if not values:
        return next((o.missing for o in outcomes if o.missing), "-")
    spread = f" ± {stdev(values):{figure.form}}" if len(values) > 1 else ""
    return f"{mean(values):{figure.form}}{spread}"


def _average(suite: Suite, figure: Score, outcomes: Sequence[Outcome]) -> str:
    """Return the mean over all sequences as text.

    If a sequence has no result, return "-": a mean over the other sequences is not comparable.
    """
    means = [
        _values(figure, [o for o in outcomes if o.entry.sequence == sequence])
        for sequence in suite.sequences
    ]
    return f"{mean(map(mean, means)):{figure.form}}" if all(means) else "-"


def _values(figure: Score, outcomes: Sequence[Outcome]) -> list[float]:
    found = [figure.of(o.evaluated) for o in outcomes if o.evaluated is not None]
    return [value for value in found if value is not None]
