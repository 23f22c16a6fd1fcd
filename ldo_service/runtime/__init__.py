"""Actor runtime: actors, the links between them, and their supervision.

- `Topic`: name and message type, with one producer (`ldo_service.schemas.topics`).
- `In`, `Out`: ports of an actor, declared as class attributes. Each input declares its delivery
  policy: `Lossless`, `Backlog` or `Latest`.
- `Actor`: inputs, outputs, `handle(message) -> messages`, `snapshot`, `restore`.
- `Outlet`: sending half of a topic. It numbers messages and waits for lossless consumers.
- `Mailbox`: bounded queue of all inputs of an actor. It counts each dropped message.
- `Stage`: takes a message, lets the actor handle it in the actor's own thread, and sends the
  outputs in order. After a failure it restores the actor from its last saved state.
- `ChildProcess`: handle in the parent process for an actor that runs in a process of its own.
- `supervise`: runs all stages in one task group. The process ends when an actor has used up its
  restart budget.
- `check_graph`: rejects a cycle of lossless inputs before anything starts.
- `Journal`: interface that receives the inputs and the results of all steps of an actor.
  `ldo_service.recordings` writes them to a file.
- `LogicalClock`: runs the whole graph offline. The result does not depend on the machine's load.

A handler is an ordinary generator: it opens no socket, reads no clock and starts no task. The stage
around it is asynchronous code.
"""

from .actor import Actor, Backlog, In, Latest, Lossless, Out
from .actor_graph import check_graph

__all__ = ["Actor", "Backlog", "In", "Latest", "Lossless", "Out", "check_graph"]
