"""A wired graph of actors: who makes what, who waits for whom."""

from collections.abc import Iterable, Sequence
from typing import Protocol

from ldo_service.errors import ConfigError, LosslessCycle

from .actor import In, Lossless, Out


class HasPorts(Protocol):
    """An actor's class, or its drawing."""

    @property
    def name(self) -> str: ...

    @property
    def inputs(self) -> tuple[In, ...]: ...

    @property
    def outputs(self) -> tuple[Out, ...]: ...


def check_graph(actors: Iterable[HasPorts]) -> None:
    """Refuse two producers of one topic, and a cycle of lossless inputs.

    Around such a cycle each actor could wait for room at the next, for ever. Raises ConfigError or
    LosslessCycle.
    """
    actors = list(actors)
    makers = producers(actors)
    waiting: dict[str, list[str]] = {
        actor.name: [
            makers[port.topic.name] for port in lossless(actor) if port.topic.name in makers
        ]
        for actor in actors
    }
    done: set[str] = set()

    def visit(name: str, path: list[str]) -> None:
        if name in path:
            raise LosslessCycle([*path[path.index(name) :], name])
        if name not in done:
            for upstream in waiting[name]:
                visit(upstream, [*path, name])
            done.add(name)

    for name in waiting:
        visit(name, [])


def producers(actors: Iterable[HasPorts]) -> dict[str, str]:
    """Topic name to the name of the actor that makes it."""
    makers: dict[str, str] = {}
    for actor in actors:
        for port in actor.outputs:
            if port.topic.name in makers:
                raise ConfigError(
                    f"{port.topic.name} is made by {makers[port.topic.name]} and by {actor.name}: "
                    "a topic has one producer."
                )
            makers[port.topic.name] = actor.name
    return makers


def lossless_consumers(actors: Iterable[HasPorts], topic_name: str) -> frozenset[str]:
    """Names of the actors that must get every message of a topic."""
    return frozenset(
        actor.name
        for actor in actors
        if any(port.topic.name == topic_name for port in lossless(actor))
    )


def lossless(actor: HasPorts) -> Sequence[In]:
    return [port for port in actor.inputs if isinstance(port.policy, Lossless)]
