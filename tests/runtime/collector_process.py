"""Process that collects numbers. Arguments: endpoint, output file, seconds per number."""

import asyncio
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from ldo_service.runtime import Actor, In, Lossless
from ldo_service.runtime.process import exit_with_parent
from ldo_service.runtime.stage import Stage, SupervisionConfig
from ldo_service.runtime.supervision import StopRequest, supervise
from ldo_service.schemas import Message
from ldo_service.schemas.topics import Topic
from ldo_service.transport.zenoh_transport import Endpoint, ZenohTransport, open_session


class Number(Message, frozen=True, kw_only=True):
    value: int


class Collector(Actor):
    name = "collector"
    inputs = (In(Topic("test/number", Number, ""), Lossless(4)),)

    def __init__(self, path: Path, step_s: float) -> None:
        super().__init__()
        self._path, self._step_s = path, step_s

    def handle(self, message: Message) -> Iterator[Message]:
        assert isinstance(message, Number)
        with self._path.open("a") as file:
            file.write(f"{message.value}\n")
        time.sleep(self._step_s)
        yield from ()


async def main(endpoint: str, path: str, step_s: str) -> None:
    network, stop = Endpoint("test", endpoint), StopRequest()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stop.request)
    with open_session(network) as session:
        transport = ZenohTransport(session, network)
        stage = Stage(
            lambda: Collector(Path(path), float(step_s)),
            transport,
            config=SupervisionConfig(heartbeat_s=0.1),
        )
        watching_parent = asyncio.create_task(exit_with_parent())
        watching_parent.add_done_callback(lambda task: None if task.cancelled() else stop.request())
        await supervise([stage], stop, drain_s=2)
        watching_parent.cancel()
        transport.close()


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
