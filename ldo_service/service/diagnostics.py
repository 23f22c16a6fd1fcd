"""Diagnosis of an actor from its messages: problems, their consequences and actions.

The diagnosis checks three signals. The liveliness token is present while the process exists.
Heartbeats arrive twice a second while the event loop runs. The age of the last step is small while
the actor handles messages.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from ldo_service.actors.topology import GRAPH
from ldo_service.schemas import Health
from ldo_service.schemas.map import MAX_ITERATIONS

# A note names a slow consumer with more unhandled messages than this: five seconds of keyframes at
# 2 Hz.
BEHIND = 10
SLOW_STEP_S = 5.0  # Eight times the slowest measured step: mapper with 1.5 million Gaussians.
# Maximum time between two steps of an actor, in seconds, if messages are queued or a camera runs.
# An actor takes a queued message after each step, and a camera sends many frames a second.
IDLE_S = 5.0
PAUSED = "is paused and takes no messages: run `ldo control resume` to continue"


@dataclass(frozen=True, slots=True)
class ActorStatus:
    """Liveliness token and last heartbeat of an actor, as a client has observed them."""

    actor: str
    has_token: bool  # The liveliness token is present.
    health: Health | None  # The last heartbeat; None: no heartbeat was received.
    listened_s: float  # Duration of the observation.
    heartbeat_age_s: float = 0.0  # Time since the last heartbeat arrived.


@dataclass(frozen=True, slots=True)
class Problem:
    """Problem of an actor, and the action that it requires from the user."""

    what: str  # Problem and consequence: a sentence whose subject, the actor, is left out.
    advice: str  # Action of the user.

    def __str__(self) -> str:
        return f"{self.what}: {self.advice}"


def diagnose(seen: ActorStatus, heartbeat_s: float = 0.5) -> Iterator[Problem]:
    """Yield the problems of an actor; none if it is healthy.

    Args:
        seen: Observations of the actor.
        heartbeat_s: Heartbeat period of the service, seconds.
    """
    if not seen.has_token and seen.health is None:
        yield Problem(
            "is not running",
            "the service restarts it as often as supervision.max_restarts allows; the log of `ldo "
            "serve` has the cause",
        )
    elif seen.health is None:
        yield _silent(f"for {seen.listened_s:.1f} s")
    elif seen.heartbeat_age_s > 3 * heartbeat_s:
        yield _silent(f"for {seen.heartbeat_age_s:.1f} s")
    else:
        if not seen.has_token:
            yield Problem(
                "sends heartbeats, but its liveliness token is absent",
                "it is stopping, or the router's access control hides it; repeat in 10 s",
            )
        yield from _of_steps(seen.health)
        yield from _of_failures(seen.health)
        yield from _of_backlogs(seen.health)
        yield from _of_disk(seen.health)
        yield from _of_models(seen.health)
        yield from _of_device(seen.health)


def _silent(how_long: str) -> Problem:
    return Problem(
        f"has a process, but no heartbeat {how_long}",
        "its process is stopped or the machine is overloaded; reduce the load. After "
        "service.heartbeat_timeout_s the service kills and restarts it",
    )


def _of_steps(health: Health) -> Iterator[Problem]:
    if problem := find_stall(health):
        yield problem


def find_stall(health: Health) -> Problem | None:
    """Return the problem of an actor that makes no progress; None if it makes progress.

    `ldo doctor` and `/readyz` share this rule. An actor makes no progress during a step of more
    than `SLOW_STEP_S`, or if it has taken none of its queued messages for `IDLE_S` since its last
    step. A long step of a back end and a wait for a labelling server are no problem: no other actor
    waits for them, and their timeouts end them. A paused actor takes no messages on request.
    """
    queued = count_queued(health)
    if health.current_step_s > SLOW_STEP_S:
        if _waits_for_server(health) or _is_backend(health.actor):
            return None  # `notes` mentions such a step.
        others = f", with {queued} more queued" if queued else ""
        return Problem(
            f"has been busy with one message for {health.current_step_s:.0f} s{others}",
            "reduce its work per message; after supervision.step_timeout_s the service stops it",
        )
    if queued and not health.current_step_s and health.step_age_s > IDLE_S and not health.paused:
        return Problem(
            f"took none of {queued} queued messages for {health.step_age_s:.0f} s",
            "free some disk space, because it cannot save its last step"
            if health.metrics.get("checkpoint_failing")
            else "it waits until a consumer takes its outputs; check the actors that consume them",
        )
    return None


def count_queued(health: Health) -> int:
    """Return the number of messages in the mailbox of an actor."""
    return sum(count.queued for count in health.inputs)


def _waits_for_server(health: Health) -> bool:
    """Return whether the actor is a labeller that uses an HTTP server.

    A slow server is no problem: its timeout bounds the step, and mapping continues.
    """
    return "attempts" in health.metrics


def _of_failures(health: Health) -> Iterator[Problem]:
    if health.failing:
        yield Problem(
            f"fails on every message and produces nothing ({health.dead_lettered} dead letters)",
            "the log of `ldo serve` has the traceback; restart the service with the settings that "
            "worked last, or start with an empty map by `ldo control reset`",
        )
    if health.quarantined:
        yield Problem(
            f"has quarantined {health.quarantined} messages, because each of them ended its "
            "process three times",
            f"report the files in state/{health.actor}.quarantine of the state folder; delete that "
            "folder while the service is stopped to clear the count",
        )
    if health.dead_lettered or health.restarts:
        yield Problem(
            f"failed {health.failures} times, was restarted {health.restarts} times and discarded "
            f"{health.dead_lettered} messages as dead letters",
            "the log of `ldo serve` has the traceback of each failure; report it",
        )


def _of_backlogs(health: Health) -> Iterator[Problem]:
    for output in health.outputs:
        if output.backlog_dropped:
            yield Problem(
                f"dropped {output.backlog_dropped} messages of {output.topic}, because "
                f"{' and '.join(output.behind)} did not handle them in time",
                "these actors are too slow or not running: raise supervision.backlog_mb, give them "
                "more CPU time, or choose a smaller network",
            )


def _is_backend(actor: str) -> bool:
    return any(spec.name == actor and spec.is_backend for spec in GRAPH)


def _of_disk(health: Health) -> Iterator[Problem]:
    if health.metrics.get("checkpoint_failing"):
        yield Problem(
            "cannot save its last step and handles no more keyframes until the save succeeds",
            "free some disk space, or start the service with another folder for --state",
        )
    if health.metrics.get("fell_back"):
        yield Problem(
            "started from an older state, because a newer one was damaged; the keyframes in "
            "between are lost",
            "check the disk, unless the power failed; this line disappears with the next start",
        )


def _of_models(health: Health) -> Iterator[Problem]:
    """Yield problems of the configured networks and labellers."""
    facts = health.metrics
    for what in ("network", "labeller"):
        if facts.get(f"{what}s_missing"):
            yield Problem(
                f"runs without the configured {what} and produces no results",
                "the log of `ldo serve` has the reason; `ldo models list` shows what is installed",
            )
    if failed := facts.get("inferences_failed"):
        yield Problem(
            f"had {failed:.0f} failed inferences; these keyframes have no detections",
            "the log of `ldo serve` has the first failure",
        )
    if facts.get("labeller_failing"):
        yield Problem(
            "gets no results from its labeller; "
            f"{facts.get('labellings_failed', 0):.0f} regions so far have no label",
            "check the server at vlm_labeller.url; the log of `ldo serve` has the first failure",
        )


def _of_device(health: Health) -> Iterator[Problem]:
    if health.metrics.get("device_failed"):
        yield Problem(
            "computes on the CPU, because the device of service.device is missing or failed",
            "the log of `ldo serve` has the cause; fix it and restart the service, or set "
            "service.device=cpu",
        )


def notes(seen: ActorStatus) -> Iterator[str]:
    """Yield remarks about an actor that are not problems."""
    health = seen.health
    if health is None:
        return
    from_camera = [count for count in health.inputs if count.topic.startswith("camera/")]
    if health.paused:
        yield PAUSED
    elif from_camera and sum(count.delivered for count in from_camera) == 0:
        topics = ", ".join(count.topic for count in from_camera)
        yield (
            f"has received no frame yet on {topics}: start a camera or `ldo publish SOURCE`. If a "
            "camera runs, check the router's access control, which denies messages silently"
        )
    elif from_camera and health.step_age_s > IDLE_S:
        yield (
            f"received its last frame {health.step_age_s:.0f} s ago: check the camera if it should "
            "be running"
        )
    if lost := health.metrics.get("frames_lost_in_a_row"):
        yield (
            f"has been LOST for {lost:.0f} frames: turn the camera to a place that it has mapped, "
            "in good light and without fast motion"
        )
    if health.metrics.get("networks") == 0 and not health.metrics.get("networks_missing"):
        yield "has no model and detects nothing: set detector.model to one of `ldo models`"
    if due := health.metrics.get("iterations_pending"):
        yield (
            f"has {due:.0f} refit iterations pending after a loop closure: they run while no "
            "keyframe arrives; let the robot stand still, or run "
            f"`ldo control refine --iterations {min(int(due), MAX_ITERATIONS)}`"
        )
    if dropped := health.metrics.get("label_copies_dropped"):
        yield (
            "has labels that depend on the speed of the labeller, because too many keyframes "
            f"waited for label results ({dropped:.0f} times); let the robot stand still now and "
            "then"
        )
    for output in health.outputs:
        for consumer, behind in output.behind.items():
            if behind > BEHIND:
                yield (
                    f"stores {behind} messages of {output.topic} that the slower {consumer} has "
                    "not handled yet; poses and the map do not wait for it"
                )
    is_slow = health.current_step_s > SLOW_STEP_S and not _waits_for_server(health)
    if is_slow and _is_backend(health.actor):
        yield (
            f"has been busy with one message for {health.current_step_s:.0f} s; no other actor "
            "waits for it, and after supervision.backend_step_timeout_s the service stops it"
        )
    if rejected := health.metrics.get("frames_rejected"):
        yield (
            f"rejected {rejected:.0f} camera frames or images: the log of `ldo serve` has the "
            "reason of the first one"
        )
    yield from _of_answers(health)


def _of_answers(health: Health) -> Iterator[str]:
    if _waits_for_server(health) and health.current_step_s > SLOW_STEP_S:
        yield (
            f"has waited for its server for {health.current_step_s:.0f} s, with "
            f"{count_queued(health)} more regions queued: labels are late, and mapping continues"
        )
    if refused := health.metrics.get("answers_refused"):
        questions = health.metrics.get("questions", 0)
        yield (
            f"rejected {refused:.0f} of {questions:.0f} label results, because they had no label "
            "or a label outside the vocabulary; the regions of these results have no label"
        )
    if without := health.metrics.get("answers_without_logprobs"):
        yield (
            f"received {without:.0f} label results without log-probabilities; their confidence is "
            "vlm_labeller.http.default_confidence"
        )
    if refused := health.metrics.get("names_refused"):
        yield f"rejected {refused:.0f} added names: the log of `ldo serve` has the reasons"
