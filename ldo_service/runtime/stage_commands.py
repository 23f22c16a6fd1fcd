"""Commands to the stages of a service: pause, resume, save and reset.

The service sends commands to its stages over a network that may lose messages:

- `StageCommand` (service to stage): A command to execute between two steps. The service repeats the
  command until the reply arrives.
- `StageReply` (stage to service): Success, or the reason of the failure. The stage sends the reply
  again if the command arrives again.

The numbers of a sender increase. A stage executes no command that is older than the last one of the
same sender, because the network may deliver commands out of order.

Commands:

- `pause`: Take no messages. Inputs with policy `Latest` drop arriving messages and count them. A
  file records that the service is paused, so that it is still paused after a restart.
- `resume`: Take messages again.
- `reset`: Start with an empty state, and number the output messages from 0 again.
- `save`: Write the whole state now.
- `keep`: Copy the last saved state into a generation. A generation has copies of the states of all
  actors, so that the service can fall back to them. See `generations`.

`control.Control` gives these commands to all stages of a service.
"""

import asyncio
import secrets
from collections import defaultdict
from collections.abc import Callable
from contextlib import nullcontext, suppress
from typing import Literal

import msgspec

from ldo_service.schemas import decode
from ldo_service.transport.flow_control import encode_link
from ldo_service.transport.interface import Transport, call_soon

COMMAND_KEY, REPLY_KEY = "link/command", "link/reply"
# A command without a reply after this time, in seconds, may be lost and is sent again. A
# stage that is still executing the command ignores the repetition.
REPEAT_AFTER_S = 0.25
# Replies that a stage remembers: more than the commands that a service sends at the same time.
MAX_REPLIES = 8
# Senders of which a stage remembers the last number. A process of the service has two senders.
MAX_SENDERS = 8
COUNT_BITS = 32  # Bits of a number that count the commands of the sender.
REPLACED = "was replaced by a newer command"


What = Literal["pause", "resume", "reset", "save", "keep"]


class StageCommand(msgspec.Struct, frozen=True, array_like=True):
    """Command to one stage."""

    # Unique number: the upper bits are a random number of the sender, the lower ones a count.
    number: int
    what: What  # The command; see the module.
    stage: str  # Name of the stage that executes it.
    # Both are for `keep`: the number of the generation to keep, and of the last complete one.
    generation: int = 0
    completed: int = 0


class StageReply(msgspec.Struct, frozen=True, array_like=True):
    """Reply of a stage to a command."""

    number: int  # Number of the command.
    stage: str
    error: str = ""  # Empty on success.


class CommandReceiver:
    """Receiver of commands in a stage.

    The receiver passes each command to the stage once, unless a newer command of the same sender
    has arrived. If a finished command arrives again, the receiver sends the reply again, because
    the first reply may be lost.
    """

    def __init__(
        self, stage: str, transport: Transport, take: Callable[[StageCommand], list[StageCommand]]
    ) -> None:
        """Subscribe to the commands.

        Args:
            stage: Name of the stage.
            transport: The network.
            take: Function that takes a command, and returns earlier ones that it replaces.
        """
        self._stage, self._take = stage, take
        self._loop = asyncio.get_running_loop()
        # Commands that are waiting or executed, and the last replies, by number.
        self._under_way: set[int] = set()
        self._done: dict[int, StageReply] = {}
        self._last: dict[int, int] = {}  # Highest number of each sender, by its upper bits.
        self._replies = transport.publisher(REPLY_KEY)
        transport.subscribe(COMMAND_KEY, self._arrived)

    def reply(self, command: StageCommand, error: str) -> None:
        """Send the reply to a command; an empty error means success."""
        self._under_way.discard(command.number)
        reply = self._done[command.number] = StageReply(command.number, self._stage, error)
        while len(self._done) > MAX_REPLIES:
            del self._done[next(iter(self._done))]
        self._replies.post(b"", encode_link(reply))

    def close(self) -> None:
        """Close the publisher of replies."""
        self._replies.close()

    def _arrived(self, _header: bytes, body: memoryview) -> None:
        """Decode a command on any thread, and handle it on the event loop."""
        with suppress(msgspec.DecodeError):
            command = decode(body, StageCommand)
            if command.stage == self._stage:
                call_soon(self._loop, self._take_once, command)

    def _take_once(self, command: StageCommand) -> None:
        if command.number in self._done:
            self._replies.post(b"", encode_link(self._done[command.number]))
        elif command.number in self._under_way:
            pass
        elif command.number <= self._last.get(command.number >> COUNT_BITS, 0):
            self.reply(command, REPLACED)
        else:
            self._remember(command.number)
            self._under_way.add(command.number)
            for replaced in self._take(command):
                self.reply(replaced, REPLACED)

    def _remember(self, number: int) -> None:
        """Remember the number as the highest one of its sender."""
        self._last.pop(number >> COUNT_BITS, None)  # The last senders come last.
        self._last[number >> COUNT_BITS] = number
        while len(self._last) > MAX_SENDERS:
            del self._last[next(iter(self._last))]


class CommandSender:
    """Client that a running service uses to send commands to the stages of its actors.

    A stage gets the next command when it has replied to the last one, or when that has timed out.
    Only `keep` does not wait, because a stage may be writing the previous generation for long.
    """

    def __init__(self, transport: Transport) -> None:
        self._loop = asyncio.get_running_loop()
        self._pending: dict[int, asyncio.Future[str]] = {}
        self._of_stage = defaultdict[str, asyncio.Lock](asyncio.Lock)  # Held for a command.
        self._number = (1 + secrets.randbits(30)) << COUNT_BITS  # Number of the last command.
        self._commands = transport.publisher(COMMAND_KEY)
        transport.subscribe(REPLY_KEY, self._arrived)

    async def send(
        self, what: What, stage: str, timeout_s: float, generation: tuple[int, int] = (0, 0)
    ) -> str:
        """Send a command to a stage and wait for its reply.

        Args:
            what: The command.
            stage: Name of the stage.
            timeout_s: Maximum time to wait for the reply, seconds.
            generation: Number of the generation to keep, and number of the last complete
                generation; only used by the command `keep`.

        Returns:
            An empty string on success, otherwise the error message. No reply within `timeout_s`
            counts as an error.
        """
        turn = nullcontext() if what == "keep" else self._of_stage[stage]
        try:
            async with asyncio.timeout(timeout_s), turn:
                self._number += 1
                return await self._reply_to(StageCommand(self._number, what, stage, *generation))
        except TimeoutError:
            return f"did not answer within {timeout_s:.0f} s"

    async def _reply_to(self, command: StageCommand) -> str:
        """Send a command until the reply to it arrives, and return the error in the reply."""
        reply = self._pending[command.number] = self._loop.create_future()
        try:
            while not reply.done():
                await self._commands.send(b"", encode_link(command))
                await asyncio.wait({reply}, timeout=REPEAT_AFTER_S)
            return reply.result()
        finally:
            del self._pending[command.number]

    def close(self) -> None:
        """Close the publisher of commands."""
        self._commands.close()

    def _arrived(self, _header: bytes, body: memoryview) -> None:
        """Decode a reply on any thread, and handle it on the event loop."""
        with suppress(msgspec.DecodeError):
            call_soon(self._loop, self._take_reply, decode(body, StageReply))

    def _take_reply(self, reply: StageReply) -> None:
        future = self._pending.get(reply.number)
        if future is not None and not future.done():
            future.set_result(reply.error)
