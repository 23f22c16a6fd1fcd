"""Tests of the diagnosis of actors: healthy, note, and problem with advice."""

import msgspec
import pytest

from ldo_service.schemas import Health, InputCount, OutputCount
from ldo_service.service.diagnostics import ActorStatus, diagnose, notes


def health(**fields) -> Health:
    counts = InputCount(
        topic="frame/rgbd", delivered=9, dropped=0, rejected=0, gaps=0, queued=0, peak_queued=1
    )
    healthy = Health(
        stamp_ns=1, actor="tracker", state="ready", pid=1, epoch=1, steps=9, failures=0, restarts=0,
        dead_lettered=0, step_age_s=0.1, current_step_s=0.0, step_ms_p50=1.0, step_ms_p95=2.0,
        rss_mb=100.0,
        inputs=(counts,), outputs=(),
    )  # fmt: skip
    return msgspec.structs.replace(healthy, **fields)


def inputs(topic: str = "frame/rgbd", **fields) -> tuple[InputCount, ...]:
    return (msgspec.structs.replace(health().inputs[0], topic=topic, **fields),)


def outputs(**fields) -> tuple[OutputCount, ...]:
    count = OutputCount(topic="keyframe/new", sent=9, backpressure_waits=0, evicted_consumers=0)
    return (msgspec.structs.replace(count, **fields),)


def status(
    health_message: Health | None, has_token: bool = True, heartbeat_age_s: float = 0.1
) -> ActorStatus:
    return ActorStatus("tracker", has_token, health_message, 1.5, heartbeat_age_s)


@pytest.mark.parametrize(
    "actor",
    [
        status(health()),
        status(health(step_age_s=3600.0)),  # An idle actor is healthy.
        status(health(step_age_s=60.0, paused=True, inputs=inputs(queued=3))),
        status(health(current_step_s=0.5, state="busy", inputs=inputs(queued=8))),
        status(health(current_step_s=4.0, step_age_s=9.0, state="busy", inputs=inputs(queued=8))),
        status(health(inputs=inputs(dropped=500, rejected=3))),  # A slow machine drops messages.
    ],
)
def test_healthy_actor_has_no_findings(actor: ActorStatus) -> None:
    assert list(diagnose(actor)) == []


@pytest.mark.parametrize(
    ("actor", "text"),
    [
        (status(None, has_token=False), "is not running"),
        (status(None), "no heartbeat for 1.5 s"),
        (status(health(), heartbeat_age_s=1.6), "no heartbeat for 1.6 s"),
        (status(health(), has_token=False), "token is absent"),
        (
            status(health(current_step_s=12.0, inputs=inputs(queued=1))),
            "busy with one message for 12 s, with 1 more queued",
        ),
        (
            status(health(current_step_s=12.0, metrics={"labellers": 1.0})),  # It uses no server.
            "busy with one message for 12 s",
        ),
        (
            status(health(step_age_s=20.0, inputs=inputs(queued=4))),
            "none of 4 queued messages",
        ),
        (
            status(health(step_age_s=20.0, inputs=inputs(queued=4), metrics={"attempts": 7.0})),
            "none of 4 queued messages",
        ),
        (status(health(dead_lettered=1, failures=2, restarts=2)), "1 messages as dead letters"),
        (
            status(health(metrics={"networks_missing": 1.0, "networks": 0.0})),
            "without the configured network",
        ),
        (status(health(metrics={"inferences_failed": 3.0})), "3 failed inferences"),
        (status(health(metrics={"device_failed": 1.0})), "computes on the CPU, because the device"),
        (status(health(metrics={"labellers_missing": 1.0})), "without the configured labeller"),
        (
            status(health(metrics={"labeller_failing": 1.0, "labellings_failed": 2.0})),
            "2 regions so far have no label",
        ),
        (
            status(health(metrics={"checkpoint_failing": 1.0, "checkpoints_failed": 3.0})),
            "cannot save its last step",
        ),
        (status(health(metrics={"fell_back": 1.0})), "started from an older state"),
        (status(health(quarantined=2)), "has quarantined 2 messages"),
        (
            status(health(outputs=outputs(behind={"detector": 900}, backlog_dropped=7))),
            "dropped 7 messages of keyframe/new, because detector did not handle them in time",
        ),
    ],
)
def test_each_problem_has_its_own_finding(actor: ActorStatus, text: str) -> None:
    (finding,) = diagnose(actor)
    assert text in finding.what
    assert len(finding.advice) > 20


@pytest.mark.parametrize(
    ("health_message", "text"),
    [
        (health(paused=True), "ldo control resume"),
        (health(inputs=inputs("camera/rgbd", delivered=0)), "no frame yet"),
        (health(inputs=inputs("camera/rgbd"), step_age_s=9.0), "last frame 9 s ago"),
        (
            health(
                current_step_s=12.0,
                step_age_s=12.0,
                inputs=inputs(queued=3),
                metrics={"attempts": 7.0},
            ),
            "its server for 12 s, with 3 more regions queued: labels are late",
        ),
        (
            health(metrics={"answers_refused": 2.0, "questions": 9.0}),
            "rejected 2 of 9 label results",
        ),
        (health(metrics={"answers_without_logprobs": 4.0}), "default_confidence"),
        (health(metrics={"frames_rejected": 16.0}), "rejected 16 camera frames"),
        (health(metrics={"frames_lost_in_a_row": 4.0}), "LOST for 4 frames"),
        (health(metrics={"names_refused": 1.0}), "rejected 1 added names"),
        (health(metrics={"label_copies_dropped": 2.0}), "label results (2 times)"),
        (health(metrics={"iterations_pending": 40.0}), "ldo control refine --iterations 40`"),
        (
            health(outputs=outputs(behind={"mapper": 3, "detector": 40})),
            "stores 40 messages of keyframe/new that the slower detector",
        ),
        (
            health(actor="optimizer", current_step_s=12.0),
            "12 s; no other actor waits for it",
        ),
        (health(metrics={"iterations_pending": 900.0}), "ldo control refine --iterations 500`"),
    ],
)
def test_harmless_condition_is_a_note(health_message: Health, text: str) -> None:
    (note,) = notes(status(health_message))
    assert text in note
    assert list(diagnose(status(health_message))) == []


def test_detector_without_model_is_a_note() -> None:
    actor = status(health(metrics={"networks": 0.0, "networks_missing": 0.0}))
    assert list(diagnose(actor)) == []
    (note,) = notes(actor)
    assert "ldo models" in note
    assert list(notes(status(health(metrics={"networks": 1.0})))) == []
