"""Checks of the graph of actors: one producer for each topic, no cycle of lossless inputs."""

from collections.abc import Iterable, Sequence
from typing import Protocol

from ldo_service.errors import ConfigError, LosslessCycle

from .actor import Backlog, In, Lossless, Out


class HasPorts(Protocol):
    """Actor class, or another description of an actor's ports."""

    @property
    def name(self) -> str: ...

    @property
    def inputs(self) -> tuple[In, ...]: ...

    @property
    def outputs(self) -> tuple[Out, ...]: ...


def check_graph(actors: Iterable[HasPorts]) -> None:
    """Reject two producers of one topic and a cycle of lossless inputs.

    In such a cycle each actor could wait forever for credit from the next.

    Raises:
        ConfigError: A topic has two producers.
        LosslessCycle: Lossless inputs form a cycle.
    """
    actors = list(actors)
    makers = producers(actors)
    waiting: dict[str, list[str]] = {
        actor.name: [
            makers[port.topic.name]
            for port in lossless(actor)
            if port.topic.name in makers and not isinstance(port.policy, Backlog)
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
    """Return the name of the producing actor for each topic name.

    Raises:
        ConfigError: A topic has two producers.
    """
    makers: dict[str, str] = {}
    for actor in actors:
        for port in actor.outputs:
            if port.topic.name in makers:
                raise ConfigError(
                    f"topic {port.topic.name} has two producers, {makers[port.topic.name]} and "
                    f"{actor.name}; it must have one. Remove it from the outputs of one actor."
                )
            makers[port.topic.name] = actor.name
    return makers


def lossless_consumers(actors: Iterable[HasPorts], topic_name: str) -> frozenset[str]:
    """Return the names of the actors that must receive every message of a topic."""
    return frozenset(
        actor.name
        for actor in actors
        if any(port.topic.name == topic_name for port in lossless(actor))
    )


def consumers_with_backlog(actors: Iterable[HasPorts], topic_name: str) -> frozenset[str]:
    """Return the names of the lossless consumers for which the producer of a topic never waits."""
    return frozenset(
        actor.name
        for actor in actors
        if any(
            port.topic.name == topic_name and isinstance(port.policy, Backlog)
            for port in actor.inputs
        )
    )


def lossless(actor: HasPorts) -> Sequence[In]:
    """Return the lossless inputs of an actor."""
    return [port for port in actor.inputs if isinstance(port.policy, Lossless)]
