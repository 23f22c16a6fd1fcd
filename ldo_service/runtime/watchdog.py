"""What systemd is told: that the service is up, and again and again that its event loop turns.

The protocol is that of sd_notify(3): a word in a datagram to the socket that the environment names.
A unit with `WatchdogSec=` restarts a service whose loop stood still for so long.
"""

import asyncio
import os
import socket
from collections.abc import Mapping
from contextlib import suppress

PINGS_PER_PERIOD = 3  # sd_watchdog_enabled(3) asks for two; one may come late on a busy machine


class Watchdog:
    """Says nothing where nobody listens."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        watched = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        period = environment.get("WATCHDOG_USEC", "") if watched else ""
        self.period_s = int(period) * 1e-6 if period.isdecimal() else 0.0  # 0: not watched

    def tell(self, word: str) -> None:
        if not self._address:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify, suppress(OSError):
            notify.setblocking(False)
            notify.sendto(word.encode(), self._address)

    async def ping(self) -> None:
        """For ever, on the event loop that is watched; returns at once when nobody does."""
        while self.period_s > 0:
            self.tell("WATCHDOG=1")
            await asyncio.sleep(self.period_s / PINGS_PER_PERIOD)
