"""Actors, the links between them, and what keeps them alive.

    Topic       name + message type, one producer (`ldo_service.schemas.topics`)
    In, Out     ports as class data; the policy belongs to the input: Lossless or Latest
    Actor       inputs, outputs, handle(message) -> messages, snapshot, restore
    Outlet      sending half of a topic: numbers messages, waits for lossless consumers
    Mailbox     all inputs of an actor, merged and bounded; every drop is counted
    Stage       take -> handle in the actor's own thread -> send in order; restarts its actor
    ChildProcess  an actor in a process of its own, seen from the process that started it
    supervise   one task group; an exhausted restart budget ends the process
    check_graph refuses a cycle of lossless inputs before anything starts
    Journal     what determined each step of an actor; `ldo_service.recordings` keeps it in a file
    run_on_logical_clock   the whole graph over a file, independent of the machine's load

A handler is an ordinary generator: it opens no socket, reads no clock, starts no task. The stage
around it is the only asynchronous code.
"""

from .actor import Actor, In, Latest, Lossless, Out
from .actor_graph import check_graph

__all__ = ["Actor", "In", "Latest", "Lossless", "Out", "check_graph"]
