"""What the service tells its stages, over a network that may lose messages.

Order    service -> stage   "do this", between two steps; repeated until reported
Report   stage -> service   "order n is done", or why not; said again for each repetition

hold      take nothing; what arrives at a Latest input is left out and counted as paused
release   take again
renew     begin anew, with an empty state and a new epoch
save      write the whole state now
"""

import asyncio
import secrets
from collections.abc import Callable
from contextlib import suppress
from typing import Literal

import msgspec

from ldo_service.schemas import decode

from .links import encode_link
from .transport import Transport, call_soon

ORDER_KEY, REPORT_KEY = "link/order", "link/report"
REPEAT_AFTER_S = 0.25  # an order or its report got lost; a stage at work is asked again in vain

What = Literal["hold", "release", "renew", "save"]


class Order(msgspec.Struct, frozen=True, array_like=True):
    number: int  # no other order has it
    what: What
    stage: str


class Report(msgspec.Struct, frozen=True, array_like=True):
    number: int
    stage: str
    error: str = ""  # empty: done


class OrderTaker:
    """The stage's end: hands over each order once, and repeats its report when asked again."""

    def __init__(self, stage: str, transport: Transport, take: Callable[[Order], None]) -> None:
        self._stage, self._take = stage, take
        self._loop = asyncio.get_running_loop()
        self._under_way = 0
        self._done: Report | None = None
        self._reports = transport.publisher(REPORT_KEY)
        transport.subscribe(ORDER_KEY, self._arrived)

    def report(self, order: Order, error: str) -> None:
        self._done = Report(order.number, self._stage, error)
        self._reports.post(b"", encode_link(self._done))

    def close(self) -> None:
        self._reports.close()

    def _arrived(self, _header: bytes, body: memoryview) -> None:
        """On any thread."""
        with suppress(msgspec.DecodeError):
            order = decode(body, Order)
            if order.stage == self._stage:
                call_soon(self._loop, self._take_once, order)

    def _take_once(self, order: Order) -> None:
        if self._done is not None and order.number == self._done.number:
            self._reports.post(b"", encode_link(self._done))
        elif order.number != self._under_way:
            self._under_way = order.number
            self._take(order)


class Commander:
    """The service's end."""

    def __init__(self, transport: Transport) -> None:
        self._loop = asyncio.get_running_loop()
        self._reports: dict[int, asyncio.Future[str]] = {}
        self._orders = transport.publisher(ORDER_KEY)
        transport.subscribe(REPORT_KEY, self._arrived)

    async def order(self, what: What, stage: str, timeout_s: float) -> str:
        """Empty when it is done, else why it is not; does not raise for what a stage does."""
        order = Order(1 + secrets.randbits(62), what, stage)
        report = self._reports[order.number] = self._loop.create_future()
        try:
            async with asyncio.timeout(timeout_s):
                while not report.done():
                    await self._orders.send(b"", encode_link(order))
                    await asyncio.wait({report}, timeout=REPEAT_AFTER_S)
                return report.result()
        except TimeoutError:
            return f"did not answer within {timeout_s:.0f} s"
        finally:
            del self._reports[order.number]

    def close(self) -> None:
        self._orders.close()

    def _arrived(self, _header: bytes, body: memoryview) -> None:
        """On any thread."""
        with suppress(msgspec.DecodeError):
            call_soon(self._loop, self._reported, decode(body, Report))

    def _reported(self, report: Report) -> None:
        future = self._reports.get(report.number)
        if future is not None and not future.done():
            future.set_result(report.error)
