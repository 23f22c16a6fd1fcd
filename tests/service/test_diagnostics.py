"""Each of the three levels of health, judged, and what to do."""

import msgspec
import pytest

from ldo_service.schemas import Health, InputCount
from ldo_service.service.diagnostics import ActorStatus, diagnose, notes


def health(**fields) -> Health:
    counts = InputCount(
        topic="frame/rgbd", delivered=9, dropped=0, rejected=0, gaps=0, queued=0, peak_queued=1
    )
    well = Health(
        stamp_ns=1, actor="tracker", state="ready", pid=1, epoch=1, steps=9, failures=0, restarts=0,
        dead_lettered=0, step_age_s=0.1, current_step_s=0.0, step_ms_p50=1.0, step_ms_p95=2.0,
        rss_mb=100.0,
        inputs=(counts,), outputs=(),
    )  # fmt: skip
    return msgspec.structs.replace(well, **fields)


def inputs(topic: str = "frame/rgbd", **fields) -> tuple[InputCount, ...]:
    return (msgspec.structs.replace(health().inputs[0], topic=topic, **fields),)


def seen(of: Health | None, has_token: bool = True, heartbeat_age_s: float = 0.1) -> ActorStatus:
    return ActorStatus("tracker", has_token, of, 1.5, heartbeat_age_s)


@pytest.mark.parametrize(
    "actor",
    [
        seen(health()),
        seen(health(step_age_s=3600.0)),  # nothing to do is no trouble
        seen(health(step_age_s=60.0, paused=True, inputs=inputs(queued=3))),
        seen(health(current_step_s=0.5, state="busy", inputs=inputs(queued=8))),
        seen(health(current_step_s=4.0, step_age_s=9.0, state="busy", inputs=inputs(queued=8))),
        seen(health(inputs=inputs(dropped=500, rejected=3))),  # what a slow machine does
    ],
)
def test_an_actor_that_is_well_has_no_trouble(actor: ActorStatus) -> None:
    assert list(diagnose(actor)) == []


@pytest.mark.parametrize(
    ("actor", "says"),
    [
        (seen(None, has_token=False), "is not running"),
        (seen(None), "no heartbeat for 1.5 s"),
        (seen(health(), heartbeat_age_s=1.6), "no heartbeat for 1.6 s"),
        (seen(health(), has_token=False), "token is absent"),
        (
            seen(health(current_step_s=12.0, inputs=inputs(queued=1))),
            "busy with one message for 12 s",
        ),
        (
            seen(health(current_step_s=12.0, metrics={"labellers": 1.0})),  # no server's
            "busy with one message for 12 s",
        ),
        (seen(health(step_age_s=20.0, inputs=inputs(queued=4))), "none of 4 queued messages"),
        (
            seen(health(step_age_s=20.0, inputs=inputs(queued=4), metrics={"attempts": 7.0})),
            "none of 4 queued messages",
        ),
        (seen(health(dead_lettered=1, failures=2, restarts=2)), "1 messages as dead letters"),
        (
            seen(health(metrics={"networks_missing": 1.0, "networks": 0.0})),
            "without the configured network",
        ),
        (seen(health(metrics={"inferences_failed": 3.0})), "3 failed inferences"),
        (seen(health(metrics={"labellers_missing": 1.0})), "without the configured labeller"),
        (
            seen(health(metrics={"labeller_failing": 1.0, "labellings_failed": 2.0})),
            "2 regions so far have no label",
        ),
        (
            seen(health(metrics={"checkpoint_failing": 1.0, "checkpoints_failed": 3.0})),
            "cannot save its last step",
        ),
    ],
)
def test_each_trouble_is_told_from_the_others(actor: ActorStatus, says: str) -> None:
    (trouble,) = diagnose(actor)
    assert says in trouble.what
    assert len(trouble.advice) > 20


@pytest.mark.parametrize(
    ("of", "says"),
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
        (health(metrics={"names_refused": 1.0}), "rejected 1 added names"),
        (health(metrics={"iterations_pending": 40.0}), "ldo control refine --iterations 40`"),
        (health(metrics={"iterations_pending": 900.0}), "ldo control refine --iterations 500`"),
    ],
)
def test_what_is_no_fault_is_a_remark(of: Health, says: str) -> None:
    (remark,) = notes(seen(of))
    assert says in remark
    assert list(diagnose(seen(of))) == []


def test_a_detector_without_a_model_is_no_trouble_and_is_remarked_upon() -> None:
    actor = seen(health(metrics={"networks": 0.0, "networks_missing": 0.0}))
    assert list(diagnose(actor)) == []
    (remark,) = notes(actor)
    assert "ldo models" in remark
    assert list(notes(seen(health(metrics={"networks": 1.0})))) == []
