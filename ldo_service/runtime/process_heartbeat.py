"""Heartbeat from a child process to its parent process, over a pipe.

The event loop of a stage sends its health messages. A step that holds the GIL, such as a gtsam
solve, blocks the event loop until the step ends. A C++ thread that does not need the GIL therefore
sends heartbeats over the pipe. Each heartbeat contains the time since the current step started.
"""

import asyncio
import os
import struct
from collections.abc import Callable, Mapping

from ._heartbeat import Heartbeat

PIPE_VARIABLE = "LDO_HEARTBEAT_FD"  # File descriptor of the pipe in the child process.
PERIOD_S = 0.5  # Time between two heartbeats.
_BEAT = struct.Struct("d")  # Age of the current step, seconds; 0 between steps.


def start_heartbeat(environment: Mapping[str, str] = os.environ) -> Heartbeat | None:
    """Start the heartbeat of this process; return None if no parent process reads it."""
    number = environment.get(PIPE_VARIABLE, "")
    return Heartbeat(int(number), PERIOD_S) if number.isdecimal() else None


class HeartbeatPipe:
    """Heartbeat pipe of one child process, read by the parent on its event loop."""

    def __init__(self, on_beat: Callable[[float], None]) -> None:
        """Open the pipe.

        Args:
            on_beat: Called with the age of the child's current step in seconds; 0 between steps.
        """
        self._on_beat = on_beat
        self._loop = asyncio.get_running_loop()
        self._reader, self._writer = os.pipe()
        for end in (self._reader, self._writer):
            os.set_blocking(end, False)
        self._loop.add_reader(self._reader, self._read)

    @property
    def writer(self) -> int:
        """File descriptor that the child process inherits."""
        return self._writer

    def close_writer(self) -> None:
        """Close the writing end in this process, after the child process has inherited it."""
        if self._writer >= 0:
            os.close(self._writer)
            self._writer = -1

    def close(self) -> None:
        """Close the pipe."""
        self.close_writer()
        if self._reader >= 0:
            self._loop.remove_reader(self._reader)
            os.close(self._reader)
            self._reader = -1

    def _read(self) -> None:
        raw = os.read(self._reader, 512 * _BEAT.size)
        if not raw:  # The child process has ended.
            self._loop.remove_reader(self._reader)
        elif len(raw) >= _BEAT.size:
            newest = len(raw) // _BEAT.size * _BEAT.size
            self._on_beat(*_BEAT.unpack_from(raw, newest - _BEAT.size))
