"""Process that collects numbers.

Arguments: endpoint, output file, seconds per number. Optional further arguments: state folder, a
number that ends the process, and how it does so (crash or hang).
"""

import asyncio
import os
import signal
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ldo_service.errors import StageError
from ldo_service.runtime import Actor, In, Lossless
from ldo_service.runtime.process import exit_with_parent
from ldo_service.runtime.stage import Stage, SupervisionConfig
from ldo_service.runtime.supervision import StopRequest, supervise
from ldo_service.schemas import Message
from ldo_service.schemas.topics import Topic
from ldo_service.storage.state_store import FolderStore
from ldo_service.transport.zenoh_transport import Endpoint, ZenohTransport, open_session


class Number(Message, frozen=True, kw_only=True):
    value: int


class Collector(Actor):
    name = "collector"
    inputs = (In(Topic("test/number", Number, ""), Lossless(4)),)

    def __init__(self, path: Path, step_s: float, poison: int, how: str) -> None:
        super().__init__()
        self._path, self._step_s, self._poison, self._how = path, step_s, poison, how
        self.count = 0

    def handle(self, message: Message) -> Iterator[Message]:
        assert isinstance(message, Number)
        with self._path.open("a") as file:
            file.write(f"{message.value}\n")
        if message.value == self._poison and self._how == "crash":
            os.kill(os.getpid(), signal.SIGSEGV)  # A kernel with an error does so.
        time.sleep(1000 if message.value == self._poison else self._step_s)
        self.count += 1
        yield from ()

    def snapshot(self) -> dict[str, int]:
        return {"count": self.count}

    def restore(self, state: Mapping[str, Any]) -> None:
        self.count = state["count"]


async def main(
    endpoint: str, path: str, step_s: str, state: str = "", poison: str = "-1", how: str = ""
) -> None:
    network, stop = Endpoint("test", endpoint), StopRequest()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stop.request)
    with open_session(network) as session:
        transport = ZenohTransport(session, network)
        stage = Stage(
            lambda: Collector(Path(path), float(step_s), int(poison), how),
            transport,
            config=SupervisionConfig(heartbeat_s=0.1, stall_after_s=1.0 if how else 60.0),
            store=FolderStore(Path(state)) if state else None,
        )
        watching_parent = asyncio.create_task(exit_with_parent())
        watching_parent.add_done_callback(lambda task: None if task.cancelled() else stop.request())
        await supervise([stage], stop, drain_s=2)
        watching_parent.cancel()
        transport.close()


if __name__ == "__main__":
    try:
        asyncio.run(main(*sys.argv[1:]))
    except StageError as error:
        os._exit(error.exit_code)  # The thread of a hanging step cannot be stopped.
