"""The page of a batch."""

from ldo_service.batch.job import Costs, Outcome
from ldo_service.batch.report import page, report_of

COSTS = Costs(
    wall_s=4.0,
    cpu_s=3.0,
    run_cpu_s=2.0,
    evaluation_cpu_s=1.0,
    peak_rss_mb=300.0,
    source_bytes=10**6,
    result_bytes=10**6,
    recording_s=90.0,
    host="here",
)
DONE = Outcome(
    source="/night/desk",
    name="desk",
    folder="desk-1a",
    status="done",
    summary={"frames": 3, "keyframes": 1, "gaussians": 1200, "status": {"OK": 3}},
    costs=COSTS,
    pictures=("trajectory.png",),
)
FAILED = Outcome(
    source="/night/<b>.bag",
    name="<b>",
    folder="",
    status="failed",
    error="<b> is damaged. Repair it by `rosbag reindex <b>.bag`.",
)


def test_row_has_the_picture_and_the_link_of_a_result() -> None:
    text = page(report_of([DONE], 5.0, is_interrupted=False))
    assert '<a href="desk-1a/result.json">desk</a>' in text
    assert '<img loading="lazy" src="desk-1a/trajectory.png" alt="trajectory.png of desk">' in text
    assert "<td>1,200</td>" in text


def test_failure_is_escaped_and_its_command_is_marked() -> None:
    text = page(report_of([FAILED], 5.0, is_interrupted=False))
    assert "&lt;b&gt; is damaged. Repair it by <code>rosbag reindex &lt;b&gt;.bag</code>." in text
    assert "<b>" not in text


def test_short_durations_are_seconds_and_long_ones_minutes() -> None:
    short = page(report_of([DONE], 5.0, is_interrupted=False))
    assert "for 90 s of recordings" in short
    assert " UTC after 5 s. " in short
    long = page(report_of([DONE, DONE], 660.0, is_interrupted=True))
    assert "for 3.0 min of recordings" in long
    assert " UTC after 11.0 min, interrupted. " in long
