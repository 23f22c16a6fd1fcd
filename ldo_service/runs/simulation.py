"""Run of all actors on the logical clock, to compute a digest of each actor's outputs."""

import hashlib
from dataclasses import dataclass

from ldo_service.actors.topology import make_actors
from ldo_service.config import Config, actor_parameters, latency_frames
from ldo_service.errors import DataError
from ldo_service.geometry import Trajectory
from ldo_service.geometry.sequence import Sequence
from ldo_service.runtime.journal import digest
from ldo_service.runtime.logical_clock import LogicalClock
from ldo_service.schemas import Message, encode

from .job import Advance
from .source import FrameReader, Selection, Warn, interleave_prior


@dataclass(frozen=True, slots=True)
class ActorDigest:
    """Number and digest of the outputs of an actor."""

    messages: int
    digest: str  # BLAKE2b of 16 bytes over the digests of all messages, hexadecimal.


class Digests:
    """Digests of the outputs of all actors, updated with each output."""

    def __init__(self, actors: list[str]) -> None:
        self._counts = dict.fromkeys(actors, 0)
        self._states = {actor: hashlib.blake2b(digest_size=16) for actor in actors}

    def observe(self, actor: str, message: Message) -> None:
        """Update the digest of an actor with one of its outputs."""
        self._counts[actor] += 1
        self._states[actor].update(digest(encode(message)).encode())

    def made(self) -> dict[str, ActorDigest]:
        """Return the digest of the outputs of each actor, by name of the actor."""
        return {
            actor: ActorDigest(count, self._states[actor].hexdigest())
            for actor, count in self._counts.items()
        }


def simulate_graph(
    sequence: Sequence,
    config: Config,
    selection: Selection,
    warn: Warn,
    advance: Advance,
    prior: Trajectory | None = None,
) -> dict[str, ActorDigest]:
    """Run all actors over the selected frames and return the digest of the outputs of each actor.

    The digests do not depend on the load of the machine or on the number of threads; see
    `runtime.logical_clock`.

    Raises:
        DataError: No frame can be read.
        StageError: An actor fails.
    """
    reader = FrameReader(sequence, selection.indices(sequence), warn)
    actors = make_actors(actor_parameters(config))
    digests = Digests([actor.name for actor in actors])
    with LogicalClock(
        actors,
        latency_frames(config),
        lambda actor, message, _step_ms: digests.observe(actor, message),
    ) as clock:
        for done in clock.run(interleave_prior(reader, prior)):
            advance(done + 1 + reader.rejected)
        clock.finish()
    made = digests.made()
    if not any(entry.messages for entry in made.values()):
        raise DataError(
            f"none of the selected frames of {sequence.name} could be used. The errors of the "
            "first frames are printed above."
        )
    return made
