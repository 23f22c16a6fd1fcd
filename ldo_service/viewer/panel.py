"""Texts of the side panel of the window, in Markdown."""

import re
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ldo_service.schemas import Health, TrackedPose

RATE_OVER_S = 5.0  # Ten heartbeats.
SILENT_AFTER_S = 1.5  # Three heartbeats.
MAX_NAME = 40  # Maximum characters of a name, because the panel is narrow.


def escaped(text: str) -> str:
    """Escape plain text for Markdown.

    Names come from messages and must not be interpreted as markup.
    """
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", " ".join(text.split()))


# --- of a run -------------------------------------------------------------------------------------
def of_summary(summary: Mapping[str, Any]) -> str:
    """Format the values of summary.json as Markdown; missing and invalid values are omitted."""
    counts = [
        f"{summary[name]:,} {says}"
        for name, says in (
            ("frames", "frames"),
            ("keyframes", "keyframes"),
            ("gaussians", "Gaussians"),
            ("objects", "objects"),
            ("loops_accepted", "loop closures"),
        )
        if isinstance(summary.get(name), int)
    ]
    fps = summary.get("fps")
    speed = [f"{fps:.1f} frames/s"] if isinstance(fps, int | float) else []
    stages = summary.get("stage_ms")
    rows = [
        f"| {escaped(actor)} | {ms['p50']:.0f} | {ms['p95']:.0f} |"
        for actor, ms in (stages if isinstance(stages, dict) else {}).items()
        if isinstance(ms, dict)
        and all(isinstance(ms.get(name), int | float) for name in ("p50", "p95"))
    ]
    table = ["| actor | ms p50 | p95 |\n|---|---|---|", *rows] if rows else []
    return "\n\n".join(filter(None, (", ".join([*counts, *speed]), "\n".join(table))))


def under_way(frames: int) -> str:
    """Return the text for a run in progress."""
    return f"**in progress**: {frames:,} frames so far. The map is written at the end of the run."


def share_shown(shown: int, there: int) -> str:
    """Return the number of drawn Gaussians and of all Gaussians as text; empty if all are drawn."""
    return f"{shown:,} of {there:,} Gaussians are drawn" if shown < there else ""


# --- of a service ---------------------------------------------------------------------------------
@dataclass(slots=True)
class Rate:
    """Rate of a counter over the last RATE_OVER_S seconds."""

    _counts: deque[tuple[float, int]] = field(default_factory=deque)  # Times in s, and counts.

    def add(self, now_s: float, count: int) -> None:
        """Add the value of the counter at the time `now_s`."""
        if self._counts and count < self._counts[-1][1]:
            self._counts.clear()  # The counter was reset.
        self._counts.append((now_s, count))
        while now_s - self._counts[0][0] > RATE_OVER_S:
            self._counts.popleft()

    @property
    def hz(self) -> float:
        """Increase of the counter per second; 0 until two values have been added."""
        (first_s, first), (last_s, last) = self._counts[0], self._counts[-1]
        return (last - first) / (last_s - first_s) if last_s > first_s else 0.0


@dataclass(slots=True)
class HeartbeatRecord:
    """Last heartbeat of an actor, and the time when it was received."""

    health: Health
    at_s: float  # Time of receipt on the clock of the scene, monotonic seconds.
    rate: Rate  # Rate of the actor's steps.


@dataclass(slots=True)
class HeardPose:
    """Last received pose of the camera, and the time of its receipt."""

    pose: TrackedPose
    at_s: float  # Time of receipt on the clock of the scene, monotonic seconds.


def of_pose(heard: HeardPose | None, poses: Rate, now_s: float) -> str:
    """Return the tracking status and the rate of poses as text.

    Args:
        heard: The last pose; None if no pose was received yet.
        poses: Rate of the received poses.
        now_s: Current time on the clock of `HeardPose.at_s`, seconds.
    """
    if heard is None:
        return "no pose yet"
    pose, silent_s = heard.pose, now_s - heard.at_s
    where = f", submap {pose.submap} not merged" if pose.submap else ""
    if silent_s > SILENT_AFTER_S:
        silent = f"**no pose for {silent_s:.0f} s**"
        return f"{silent}; the last was {pose.status} at frame {pose.frame:,}{where}"
    return f"**{pose.status}** at frame {pose.frame:,}, {poses.hz:.1f} poses/s{where}"


def of_health(heard: Iterable[HeartbeatRecord], now_s: float) -> str:
    """Return a table with one row for each actor, in Markdown.

    The columns are state, handled messages per second, handling time in ms (median and 95th
    percentile), dropped messages, and memory in MB.

    Args:
        heard: The last heartbeat of each actor.
        now_s: Current time on the clock of `HeartbeatRecord.at_s`, seconds.
    """
    rows = [_row(one, now_s) for one in sorted(heard, key=lambda one: one.health.actor)]
    if not rows:
        return "No heartbeat yet. Check the robot name, and run `ldo doctor`."
    return "\n".join(
        ("| actor | | /s | ms | p95 | drops | MB |\n|---|---|---|---|---|---|---|", *rows)
    )


def _row(one: HeartbeatRecord, now_s: float) -> str:
    health, silent_s = one.health, now_s - one.at_s
    state = "paused" if health.paused else health.state
    state = f"**silent {silent_s:.0f} s**" if silent_s > SILENT_AFTER_S else state
    cells = (
        escaped(health.actor[:MAX_NAME]),
        state,
        f"{one.rate.hz:.1f}",
        f"{health.step_ms_p50:.0f}",
        f"{health.step_ms_p95:.0f}",
        sum(count.dropped for count in health.inputs),
        f"{health.rss_mb:.0f}",
    )
    return f"| {' | '.join(map(str, cells))} |"
