"""What is wrong with an actor, from what can be seen from outside, and what to do about it.

Three levels: its liveliness token (there while its process is), its heartbeat (twice a second while
its event loop turns), and the age of its last step (young while it works).
"""

from collections.abc import Iterator
from dataclasses import dataclass

from ldo_service.schemas import Health
from ldo_service.schemas.map import MAX_ITERATIONS

SLOW_STEP_S = 5.0  # 8x the slowest step measured (mapper, 1.5 M Gaussians)
IDLE_S = 5.0  # a mailbox with messages is emptied within a step; a camera sends many a second


@dataclass(frozen=True, slots=True)
class ActorStatus:
    """What was seen of an actor while somebody listened for `listened_s`."""

    actor: str
    has_token: bool
    health: Health | None  # its last heartbeat
    listened_s: float
    heartbeat_age_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Problem:
    what: str
    advice: str

    def __str__(self) -> str:
        return f"{self.what}: {self.advice}"


def diagnose(seen: ActorStatus, heartbeat_s: float = 0.5) -> Iterator[Problem]:
    """What must be mended; nothing when the actor is well."""
    if not seen.has_token and seen.health is None:
        yield Problem(
            "is not running",
            "the log of `ldo serve` says how it ended, and when it is started again",
        )
    elif seen.health is None:
        yield _silent(f"for {seen.listened_s:.1f} s")
    elif seen.heartbeat_age_s > 3 * heartbeat_s:
        yield _silent(f"for {seen.heartbeat_age_s:.1f} s")
    else:
        if not seen.has_token:
            yield Problem(
                "reports, and its liveliness token is absent",
                "it is ending, or the router's access control hides it: look again in 10 s",
            )
        yield from _of_steps(seen.health)
        yield from _of_failures(seen.health)
        yield from _of_disk(seen.health)
        yield from _of_models(seen.health)


def _silent(how_long: str) -> Problem:
    return Problem(
        f"has a process, and no heartbeat {how_long}",
        "the process is stopped or its machine overloaded; the service kills and restarts one "
        "that stays so for service.heartbeat_timeout_s",
    )


def _of_steps(health: Health) -> Iterator[Problem]:
    waiting = _waiting(health)
    if health.current_step_s > SLOW_STEP_S:
        if _waits_for_server(health):
            return
        yield Problem(
            f"has been busy with one message for {health.current_step_s:.0f} s",
            "give it less work per message; beyond supervision.step_timeout_s it is given up",
        )
    elif waiting and not health.current_step_s and health.step_age_s > IDLE_S and not health.paused:
        yield Problem(
            f"took none of {waiting} waiting messages for {health.step_age_s:.0f} s",
            "it waits for room at a consumer: look at the actors that take what it makes",
        )


def _waiting(health: Health) -> int:
    return sum(count.queued for count in health.inputs)


def _waits_for_server(health: Health) -> bool:
    """A labeller's server may take its time: patience_s bounds that, and the map goes on."""
    return "attempts" in health.metrics


def _of_failures(health: Health) -> Iterator[Problem]:
    if health.dead_lettered or health.restarts:
        yield Problem(
            f"failed {health.failures} times, was restarted {health.restarts} times and set "
            f"{health.dead_lettered} messages aside",
            "the log of `ldo serve` has each failure",
        )


def _of_disk(health: Health) -> Iterator[Problem]:
    if health.metrics.get("checkpoint_failing"):
        yield Problem(
            "cannot save its last step, and takes no more keyframes until it can",
            "free some disk space, or start the service with another folder for --state",
        )


def _of_models(health: Health) -> Iterator[Problem]:
    """Networks and labellers that an actor was told to use."""
    facts = health.metrics
    for what in ("network", "labeller"):
        if facts.get(f"{what}s_missing"):
            yield Problem(
                f"goes on without the {what} that it was told to use",
                "the log of `ldo serve` says why; `ldo models list` shows those there are",
            )
    if failed := facts.get("inferences_failed"):
        yield Problem(
            f"had {failed:.0f} inferences fail, and these keyframes have no labels",
            "the log of `ldo serve` has the first of them; try inference.providers=[cpu]",
        )
    if facts.get("labeller_failing"):
        yield Problem(
            f"gets no answer from its labeller, {facts.get('labellings_failed', 0):.0f} regions so "
            "far stay unnamed",
            "the log of `ldo serve` has the first failure; is the server at vlm_labeller.url up?",
        )


def notes(seen: ActorStatus) -> Iterator[str]:
    """What a person wants to know and nobody has to mend."""
    health = seen.health
    if health is None:
        return
    from_camera = [count for count in health.inputs if count.topic.startswith("camera/")]
    if health.paused:
        yield "is paused: `ldo control resume` ends it"
    elif from_camera and sum(count.delivered for count in from_camera) == 0:
        topics = ", ".join(count.topic for count in from_camera)
        yield (
            f"has had no frame yet on {topics}: start a camera, or `ldo publish SOURCE`; a camera "
            "that runs may be denied by the router's access control, which tells it nothing"
        )
    elif from_camera and health.step_age_s > IDLE_S:
        yield f"had its last frame {health.step_age_s:.0f} s ago"
    if health.metrics.get("networks") == 0 and not health.metrics.get("networks_missing"):
        yield "has no model: nothing is detected until detector.model names one of `ldo models`"
    if due := health.metrics.get("iterations_pending"):
        yield (
            f"is due {due:.0f} iterations since a correction tore the map: keyframes bring some, "
            f"`ldo control refine --iterations {min(int(due), MAX_ITERATIONS)}` at once"
        )
    yield from _of_answers(health)


def _of_answers(health: Health) -> Iterator[str]:
    if _waits_for_server(health) and health.current_step_s > SLOW_STEP_S:
        yield (
            f"has asked its server about one region for {health.current_step_s:.0f} s, and "
            f"{_waiting(health)} wait: names come late, and the map goes on without"
        )
    if refused := health.metrics.get("answers_refused"):
        questions = health.metrics.get("questions", 0)
        yield f"refused {refused:.0f} of {questions:.0f} answers: no name, or not one asked for"
    if untold := health.metrics.get("answers_without_logprobs"):
        yield (
            f"had {untold:.0f} answers without log-probabilities, which count as "
            "vlm_labeller.http.default_confidence sure"
        )
    if refused := health.metrics.get("names_refused"):
        yield f"refused {refused:.0f} names that were to be added: the log says why"
