"""Report of a batch: batch.json, and a page with a row and pictures for each recording."""

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from html import escape
from typing import Any
from urllib.parse import quote

import msgspec

from ldo_service import __version__

from .job import Costs, Outcome
from .store import Store

JSON_FILE, PAGE_FILE = "batch.json", "index.html"
COLUMNS = ("recording", "result", "frames", "OK, WEAK, LOST", "keyframes", "Gaussians", "ATE cm")
COLUMNS += ("PSNR dB", "CPU s", "peak MB", "source MB", "result MB")

STYLE = """
:root { color-scheme: light dark; }
body { font: 15px/1.4 system-ui, sans-serif; margin: 2rem; }
table { border-collapse: collapse; }
th, td { padding: .35rem .7rem; text-align: right; white-space: nowrap; vertical-align: top; }
th { border-bottom: 2px solid #8888; }
td:first-child, th:first-child, td:nth-child(2), th:nth-child(2) { text-align: left; }
tbody { border-bottom: 1px solid #8884; }
td.pictures, td.text { text-align: left; white-space: normal; padding-bottom: .8rem; }
td.text { max-width: 60rem; }
img { height: 320px; max-width: 100%; margin: 0 .6rem .6rem 0; border: 1px solid #8886; }
img { object-fit: contain; background: white; }
code { font-size: .9em; background: #8882; padding: 0 .25em; }
.failed { color: #d1242f; } .kept { opacity: .75; }
"""


class Report(msgspec.Struct, frozen=True, kw_only=True):
    """Content of batch.json: the totals of a batch, and the outcome of each recording."""

    ldo: str  # Version of LDO-SLAM.
    finished: str  # Time, ISO 8601.
    wall_s: float  # Duration of the batch, seconds.
    is_interrupted: bool  # True if the batch ended early.
    counts: dict[str, int]  # Number of recordings by status.
    # Sums of the `Costs` of all recordings with results, by the name of the field: cpu_s,
    # recording_s, source_bytes and result_bytes.
    totals: dict[str, float]
    recordings: list[Outcome]  # Outcome of each recording.


def report_of(outcomes: Sequence[Outcome], wall_s: float, *, is_interrupted: bool) -> Report:
    """Return the report of a batch.

    Args:
        outcomes: Outcome of each recording.
        wall_s: Duration of the batch, seconds.
        is_interrupted: True if the batch was interrupted.
    """
    costs = [outcome.costs for outcome in outcomes if outcome.costs]
    sums = ("cpu_s", "recording_s", "source_bytes", "result_bytes")
    statuses = [outcome.status for outcome in outcomes]
    return Report(
        ldo=__version__,
        finished=datetime.now(UTC).isoformat(timespec="seconds"),
        wall_s=round(wall_s, 3),
        is_interrupted=is_interrupted,
        counts={status: statuses.count(status) for status in dict.fromkeys(statuses)},
        totals={name: round(sum(getattr(cost, name) for cost in costs), 3) for name in sums},
        recordings=list(outcomes),
    )


def save_report(out: Store, report: Report) -> None:
    """Write a report to a folder, as batch.json and as the HTML page index.html.

    Raises:
        DataError: The folder cannot be written.
    """
    out.at(JSON_FILE).write(msgspec.json.format(msgspec.json.encode(report)))
    out.at(PAGE_FILE).write(page(report).encode())


def cells(outcome: Outcome) -> list[str]:
    """Return the texts of the table row of a recording, one for each of COLUMNS."""
    summary, costs = outcome.summary, outcome.costs
    if not outcome.has_results:
        return [outcome.name, outcome.status, *("" for _ in COLUMNS[2:])]
    status = summary.get("status", {})
    ate_m = summary.get("ate_m")
    return [
        outcome.name,
        outcome.status,
        str(summary["frames"]),
        ", ".join(str(status.get(name, 0)) for name in ("OK", "WEAK", "LOST")),
        str(summary["keyframes"]),
        f"{summary['gaussians']:,}",
        _number(None if ate_m is None else 100 * ate_m, ".2f"),
        _number(summary.get("psnr_db"), ".2f"),
        *_cost_cells(costs),
    ]


def _cost_cells(costs: Costs | None) -> list[str]:
    if costs is None:
        return [""] * 4
    sizes = (costs.source_bytes, costs.result_bytes)
    return [
        f"{costs.cpu_s:.0f}",
        f"{costs.peak_rss_mb:.0f}",
        *(f"{size / 1e6:.1f}" for size in sizes),
    ]


def _number(value: Any, form: str) -> str:
    return "" if value is None else f"{value:{form}}"


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:,.1f} min"


def page(report: Report) -> str:
    """Return the report as an HTML page, whose pictures are in the folders of the results."""
    counts = ", ".join(f"{count} {status}" for status, count in report.counts.items())
    totals = report.totals
    text = (
        f"{counts or 'no recordings'}. CPU time {totals['cpu_s']:,.0f} s for "
        f"{_duration(totals['recording_s'])} of recordings; sources "
        f"{totals['source_bytes'] / 1e6:,.0f} MB, results {totals['result_bytes'] / 1e6:,.0f} MB. "
        f"Finished {report.finished.replace('T', ' ').replace('+00:00', ' UTC')} after "
        f"{_duration(report.wall_s)}"
        f"{', interrupted' if report.is_interrupted else ''}. LDO-SLAM {report.ldo}."
    )
    head = "".join(f"<th>{escape(column)}</th>" for column in COLUMNS)
    rows = "\n".join(map(_rows, report.recordings))
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f"<title>ldo batch</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        f"<h1>ldo batch</h1>\n<p>{escape(text)}</p>\n"
        f"<table>\n<thead><tr>{head}</tr></thead>\n{rows}\n</table>\n</body>\n</html>\n"
    )


def _rows(outcome: Outcome) -> str:
    name, *others = map(escape, cells(outcome))
    if outcome.has_results:
        name = f'<a href="{quote(outcome.folder)}/result.json">{name}</a>'
    row = "".join(f"<td>{cell}</td>" for cell in (name, *others))
    lines = [f'<tr class="{escape(outcome.status)}">{row}</tr>']
    texts = [outcome.error] if outcome.error else list(outcome.notes)
    if texts:
        # Messages have commands in backticks.
        text = re.sub("`([^`]+)`", r"<code>\1</code>", "<br>".join(map(escape, texts)))
        lines.append(f'<tr><td class="text" colspan="{len(COLUMNS)}">{text}</td></tr>')
    if outcome.pictures:
        pictures = "".join(_picture(outcome, name) for name in outcome.pictures)
        lines.append(f'<tr><td class="pictures" colspan="{len(COLUMNS)}">{pictures}</td></tr>')
    return f'<tbody title="{escape(outcome.source)}">{"".join(lines)}</tbody>'


def _picture(outcome: Outcome, name: str) -> str:
    address = f"{quote(outcome.folder)}/{quote(name)}"
    text = escape(f"{name} of {outcome.name}")
    return f'<a href="{address}"><img loading="lazy" src="{address}" alt="{text}"></a>'
