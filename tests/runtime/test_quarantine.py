"""Tests of messages that end the process of their actor."""

import asyncio
import os
import struct
import sys
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
import zenoh

from ldo_service.runtime import In, Latest, Lossless
from ldo_service.runtime.actor import Out
from ldo_service.runtime.inlet import Delivery
from ldo_service.runtime.outlet import Outlet
from ldo_service.runtime.process import ChildProcess
from ldo_service.runtime.quarantine import (
    MAX_DELIVERIES,
    MAX_FILES,
    MAX_SUSPECTS,
    Quarantine,
    QuarantinedMessage,
    _key_of,
)
from ldo_service.runtime.supervision import StopRequest, supervise
from ldo_service.transport.flow_control import Header
from ldo_service.transport.zenoh_transport import Endpoint, ZenohTransport

from .fake_actors import NUMBERS, eventually, number, send

PROGRAM = Path(__file__).with_name("collector_process.py")
POISON = 2


def delivery(seq: int, policy: Lossless | Latest | None = None) -> Delivery:
    port = In(NUMBERS, policy or Lossless(4))
    return Delivery(port, Header("producer", 1, seq, 1), memoryview(b"body"))


class ProcessEnd(BaseException):
    """End of the process inside a step."""


async def end_process_while_handling(folder: Path, one: Delivery) -> None:
    with pytest.raises(ProcessEnd):
        async with Quarantine(folder).counting(one):
            raise ProcessEnd


@pytest.mark.slow
@pytest.mark.parametrize("how", ["crash", "hang"])
async def test_message_that_ends_its_process_is_handled_three_times(
    network: Endpoint, client: Callable[[], zenoh.Session], tmp_path: Path, how: str
) -> None:
    numbers, transport = tmp_path / "numbers", ZenohTransport(client(), network)
    source = Outlet(Out(NUMBERS), "producer", 1, transport, ["collector"])
    arguments = (network.endpoint, numbers, 0.0, tmp_path / "state", POISON, how)
    process = ChildProcess(
        "collector", [sys.executable, str(PROGRAM), *map(str, arguments)], transport
    )
    stop = StopRequest()
    service = asyncio.create_task(supervise([process], stop))
    for value in range(5):
        await send(source, number(value))

    def health_counts() -> int:
        health = process.health()
        return health.quarantined if health else 0

    await eventually(lambda: numbers.exists() and "4" in numbers.read_text().split())
    await eventually(lambda: health_counts() == 1)
    stop.request()
    await service
    handled = Counter(int(line) for line in numbers.read_text().split())
    assert handled[POISON] == MAX_DELIVERIES
    assert set(handled) == set(range(5))
    (file,) = (tmp_path / "state" / "collector.quarantine").glob("*.message")
    saved = msgspec.msgpack.decode(file.read_bytes(), type=QuarantinedMessage)
    assert (saved.topic, saved.seq, saved.deliveries) == (NUMBERS.name, POISON, MAX_DELIVERIES)


async def test_deliveries_are_counted_across_processes_until_a_success(tmp_path: Path) -> None:
    poison, good = delivery(7), delivery(8)
    for _ in range(MAX_DELIVERIES):
        assert not Quarantine(tmp_path).is_due(poison)
        await end_process_while_handling(tmp_path, poison)
    assert Quarantine(tmp_path).is_due(poison)
    assert not Quarantine(tmp_path).is_due(good)
    async with Quarantine(tmp_path).counting(good):
        pass
    assert not Quarantine(tmp_path).is_due(good)


async def test_count_stays_when_another_message_is_handled_between_two_deliveries(
    tmp_path: Path,
) -> None:
    poison, good = delivery(7), delivery(3)
    for _ in range(MAX_DELIVERIES):
        quarantine = Quarantine(tmp_path)
        assert not quarantine.is_due(poison)
        async with quarantine.counting(good):
            pass
        await end_process_while_handling(tmp_path, poison)
    quarantine = Quarantine(tmp_path)
    async with quarantine.counting(good):
        pass
    assert quarantine.is_due(poison)
    quarantine.add("collector", poison)
    assert Quarantine(tmp_path).is_due(poison)
    assert Quarantine(tmp_path).count == 1


async def test_stop_does_not_change_the_count_of_a_message_that_was_not_delivered_again(
    tmp_path: Path,
) -> None:
    await end_process_while_handling(tmp_path, delivery(7))
    Quarantine(tmp_path).withdraw()
    assert Quarantine(tmp_path)._deliveries_of(delivery(7)) == 1


async def test_number_of_counts_is_limited(tmp_path: Path) -> None:
    for seq in range(MAX_SUSPECTS + 2):
        await end_process_while_handling(tmp_path, delivery(seq))
    size = (tmp_path / "deliveries").stat().st_size
    async with Quarantine(tmp_path).counting(delivery(100)):
        pass
    counts = [Quarantine(tmp_path)._deliveries_of(delivery(s)) for s in range(MAX_SUSPECTS + 2)]
    assert counts == [0] * 3 + [1] * (MAX_SUSPECTS - 1)
    assert (tmp_path / "deliveries").stat().st_size == size


@pytest.mark.parametrize("has_checksum", [False, True])
async def test_count_of_an_older_version_is_read(tmp_path: Path, has_checksum: bool) -> None:
    one = delivery(7)
    record = struct.pack("<16sII", _key_of(one), MAX_DELIVERIES, 4)
    checksum = struct.pack("<I", zlib.crc32(record)) if has_checksum else b""
    (tmp_path / "deliveries").write_bytes(record + checksum)
    assert Quarantine(tmp_path).is_due(one)
    assert Quarantine(tmp_path).count == 4


async def test_handler_that_raises_is_not_counted(tmp_path: Path) -> None:
    for _ in range(MAX_DELIVERIES):
        with pytest.raises(ValueError, match="handler"):
            async with Quarantine(tmp_path).counting(delivery(1)):
                raise ValueError("handler")
    assert not Quarantine(tmp_path).is_due(delivery(1))


async def test_stop_of_the_service_is_not_counted(tmp_path: Path) -> None:
    for _ in range(MAX_DELIVERIES):
        quarantine = Quarantine(tmp_path)
        with pytest.raises(asyncio.CancelledError):
            async with quarantine.counting(delivery(1)):
                raise asyncio.CancelledError
        quarantine.withdraw()
    assert not Quarantine(tmp_path).is_due(delivery(1))


async def test_latest_message_is_never_due_because_it_is_not_delivered_again(
    tmp_path: Path,
) -> None:
    for _ in range(MAX_DELIVERIES):
        await end_process_while_handling(tmp_path, delivery(1, Latest(1)))
    assert not Quarantine(tmp_path).is_due(delivery(1, Latest(1)))


async def test_suspected_messages_of_a_process_are_handled_one_at_a_time(tmp_path: Path) -> None:
    """The message that ends the process is the only one that is counted a second time."""
    for actor in ("guilty", "innocent"):
        await end_process_while_handling(tmp_path / actor, delivery(1))
    suspects = asyncio.Lock()
    guilty, innocent = (Quarantine(tmp_path / actor, suspects) for actor in ("guilty", "innocent"))

    async def handle_the_innocent() -> None:
        async with innocent.counting(delivery(1)):
            pass

    async def end_process() -> None:
        async with guilty.counting(delivery(1)):
            waiting.append(asyncio.create_task(handle_the_innocent()))
            await asyncio.sleep(0)
            raise ProcessEnd

    waiting: list[asyncio.Task[None]] = []
    with pytest.raises(ProcessEnd):
        await end_process()
    waiting[0].cancel()
    for actor, count in (("guilty", 2), ("innocent", 1)):
        assert Quarantine(tmp_path / actor)._deliveries_of(delivery(1)) == count


async def test_folder_keeps_the_newest_messages_and_the_full_count(tmp_path: Path) -> None:
    quarantine = Quarantine(tmp_path)
    for seq in range(MAX_FILES + 5):
        assert quarantine.add("collector", delivery(seq)) == seq + 1
    assert len(list(tmp_path.glob("*.message"))) == MAX_FILES
    assert Quarantine(tmp_path).count == MAX_FILES + 5


async def test_newest_message_is_kept_although_the_clock_was_set_back(tmp_path: Path) -> None:
    quarantine = Quarantine(tmp_path)
    for seq in range(MAX_FILES):
        quarantine.add("collector", delivery(seq))
    for path in tmp_path.glob("*.message"):
        os.utime(path, (1e10, 1e10))  # Times in the future, as after the clock was set back.
    quarantine.add("collector", delivery(MAX_FILES))
    names = {path.name for path in tmp_path.glob("*.message")}
    assert len(names) == MAX_FILES
    assert f"test.number-1-{MAX_FILES}.message" in names
