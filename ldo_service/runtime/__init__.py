"""Actor runtime: actors, the links between them, and their supervision.

- `Topic`: name and message type, with one producer (`ldo_service.schemas.topics`).
- `In`, `Out`: ports as class data. The policy belongs to the input: `Lossless` or `Latest`.
- `Actor`: inputs, outputs, `handle(message) -> messages`, `snapshot`, `restore`.
- `Outlet`: sending half of a topic. It numbers messages and waits for lossless consumers.
- `Mailbox`: all inputs of an actor, merged and bounded. It counts every drop.
- `Stage`: takes a message, handles it in the actor's own thread, and sends the outputs in order.
  After a failure it restarts the actor.
- `ChildProcess`: an actor in a process of its own, seen from the parent process.
- `supervise`: one task group; an exhausted restart budget ends the process.
- `check_graph`: rejects a cycle of lossless inputs before anything starts.
- `Journal`: everything that determined each step of an actor. `ldo_service.recordings` writes it to
  a file.
- `LogicalClock`: an offline run of the whole graph, independent of the machine's load.

A handler is an ordinary generator: it opens no socket, reads no clock and starts no task. The stage
around it is the only asynchronous code.
"""

from .actor import Actor, In, Latest, Lossless, Out
from .actor_graph import check_graph

__all__ = ["Actor", "In", "Latest", "Lossless", "Out", "check_graph"]
