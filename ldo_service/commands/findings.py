"""Results of the checks of `ldo doctor`, printed as lines."""

from collections.abc import Iterable
from dataclasses import dataclass

from rich.console import Console
from rich.markup import escape

from ldo_service.errors import LdoError

MARKS = {
    "ok": "[green]ok[/]     ",
    "absent": "[dim]absent[/] ",
    "bad": "[red]bad[/]    ",
    "warn": "[yellow]warn[/]   ",
    "note": "[dim]note[/]   ",
}


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check, printed as one line."""

    # "ok", "absent" (an optional part is missing), "note" (information), "warn" (results may be
    # worse than they could be) or "bad" (needs action).
    mark: str
    text: str  # Sentence about the result, and for "warn" and "bad" about what to do.


def show(findings: Iterable[Finding]) -> None:
    """Print each finding as a line.

    Raises:
        LdoError: A line is marked bad.
    """
    console = Console(highlight=False, soft_wrap=True)
    bad = 0
    for finding in findings:
        console.print(MARKS[finding.mark] + escape(finding.text))
        bad += finding.mark == "bad"
    if bad:
        raise LdoError(
            f"problems found: {bad}. Each line above that is marked bad says how to fix a problem."
        )
