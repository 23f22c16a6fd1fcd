"""Checks of the graph of actors: one producer for each topic, no cycle of lossless inputs."""

from collections.abc import Iterable, Sequence
from typing import Protocol, TypeVar

from ldo_service.errors import ConfigError, LosslessCycle

from .actor import Backlog, In, Lossless, Out


class HasPorts(Protocol):
    """Protocol of objects with the name and ports of an actor, such as an actor class."""

    @property
    def name(self) -> str: ...

    @property
    def inputs(self) -> tuple[In, ...]: ...

    @property
    def outputs(self) -> tuple[Out, ...]: ...


T = TypeVar("T", bound=HasPorts)


def check_graph(actors: Iterable[HasPorts]) -> None:
    """Reject two producers of one topic and a cycle of lossless inputs.

    In such a cycle each actor could wait forever for credit from the next. Inputs with policy
    `Backlog` do not count, because their producer never waits.

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


def finish_order(actors: Iterable[T]) -> list[T]:
    """Return the actors in the order in which they finish, producers first where possible.

    The final messages of an actor may reach other actors, directly or through actors in between.
    For example, the last loop closure causes a correction of the map. An actor with final messages
    therefore finishes after two groups: the actors whose final messages reach it, and the actors
    in between. The rule does not apply to two actors whose final messages reach each other.

    Args:
        actors: The actors, producers first.
    """
    actors = list(actors)
    after: dict[str, set[str]] = {actor.name: set() for actor in actors}
    for last in (actor for actor in actors if _final_topics(actor)):
        for first in (actor for actor in actors if _final_topics(actor)):
            way = _reached(_final_topics(first), actors)
            if last.name in way and first.name not in _reached(_final_topics(last), actors):
                upstream = {a.name for a in actors if last.name in _reached(_topics(a), actors)}
                after[last.name] |= ({first.name} | (way & upstream)) - {last.name}
    order: list[T] = []
    while actors:
        finished = {actor.name for actor in order}
        order.append(next((a for a in actors if after[a.name] <= finished), actors[0]))
        actors.remove(order[-1])
    return order


def consumers_first(actors: Iterable[T]) -> list[T]:
    """Return the actors so that each one comes after the consumers of its lossless topics.

    The order is that of a depth-first search from each actor to its consumers. If two actors
    consume messages of each other, the actor that the search visits first comes after the other.

    Args:
        actors: The actors, producers first.
    """
    actors = list(actors)
    order: list[T] = []
    begun: set[str] = set()

    def visit(actor: T) -> None:
        if actor.name in begun:
            return
        begun.add(actor.name)
        topics = _topics(actor)
        for consumer in actors:
            if topics & {port.topic.name for port in lossless(consumer)}:
                visit(consumer)
        order.append(actor)

    for actor in actors:
        visit(actor)
    return order


def _topics(actor: HasPorts) -> set[str]:
    return {port.topic.name for port in actor.outputs}


def _final_topics(actor: HasPorts) -> set[str]:
    return {port.topic.name for port in actor.outputs if port.is_final}


def _reached(topics: set[str], actors: Sequence[HasPorts]) -> set[str]:
    """Return the names of the actors that topics reach, directly or through other actors.

    Inputs without `needs_final` are ignored.
    """
    reached: set[str] = set()
    while True:
        new = {
            actor.name
            for actor in actors
            if actor.name not in reached
            and topics & {port.topic.name for port in actor.inputs if port.needs_final}
        }
        if not new:
            return reached
        reached |= new
        topics = topics.union(*(_topics(actor) for actor in actors if actor.name in new))


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
                    f"{actor.name}, but may have only one. Remove the topic from the outputs of "
                    "one of these actors."
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
    """Return the names of the consumers of a topic that have policy `Backlog`."""
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
