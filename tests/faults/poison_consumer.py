"""Process of an actor that one message ends, of the installed package.

    poison_consumer.py ENDPOINT FOLDER NUMBER crash|hang

The message whose `iterations` is NUMBER crashes the process, or hangs. FOLDER has the state of the
actor, and the file `handled` with a line for each delivery.
"""

import asyncio
import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parents[2]))

from ldo_service.errors import StageError
from ldo_service.runtime import Actor, In, Lossless
from ldo_service.runtime.stage import Stage
from ldo_service.runtime.supervision import supervise
from ldo_service.schemas.topics import MAP_REFINE
from tests.faults.earlier_names import found, name


class Consumer(Actor):
    name = "consumer"
    inputs = (In(MAP_REFINE, Lossless(8)),)

    def __init__(self, path: Path, poison: int, how: str) -> None:
        super().__init__()
        self._path, self._poison, self._how = path, poison, how
        self.count = 0

    def handle(self, message: Any) -> Iterator[Any]:
        with self._path.open("a") as handled:
            print(message.iterations, file=handled)
        if message.iterations == self._poison and self._how == "crash":
            os.kill(os.getpid(), signal.SIGSEGV)  # A kernel with an error does so.
        if message.iterations == self._poison:
            time.sleep(1000)
        self.count += 1
        return iter(())

    def snapshot(self) -> dict[str, int]:
        return {"count": self.count}

    def restore(self, state: Any) -> None:
        self.count = state["count"]


async def main(endpoint: str, folder: str, poison: str, how: str) -> None:
    network, stop = found("Endpoint")("robot", endpoint), found("StopRequest")()
    request = getattr(stop, name("request"))
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, request)
    with found("open_session")(network) as session:
        transport = found("ZenohTransport")(session, network)
        stage = Stage(
            lambda: Consumer(Path(folder) / "handled", int(poison), how),
            transport,
            config=found("SupervisionConfig")(heartbeat_s=0.1, stall_after_s=2.0),
            store=found("FolderStore")(Path(folder) / "state"),
        )
        watching_parent = asyncio.create_task(found("exit_with_parent")())
        watching_parent.add_done_callback(lambda task: None if task.cancelled() else request())
        await supervise([stage], stop, 2.0)
        watching_parent.cancel()
        transport.close()


if __name__ == "__main__":
    try:
        asyncio.run(main(*sys.argv[1:]))
    except StageError as error:
        os._exit(error.exit_code)  # The thread of a hanging step cannot be stopped.
