"""Control interface of a service: pause, resume, save and reset of all its actors.

`Control` replies once for the whole service, when all its actors have replied. `reset` first pauses
every actor, producers first, so that no message of the old run is in flight when the actors
restart. Otherwise a graph correction from before the reset could arrive after it. The graph version
of this correction would be higher than the first versions after the reset, so the actors would
ignore the first new corrections.

If a reset does not reach all actors, some states are from before the reset and some from after it.
`Control` therefore writes a marker to the disk before the first actor is reset. It removes the
marker once the empty states of all actors are on the disk as a generation. A generation is a synced
copy of all states, to which the service can fall back (`generations`). While the marker exists, all
actors are paused, and the next start of the service completes the reset.

An actor that was reset connects to its producers only when it is resumed. If it connected earlier,
it could receive messages of the old run from a producer that is not reset yet.
"""

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from ldo_service.schemas import ControlAnswer, ControlRequest, decode, encode
from ldo_service.storage.atomic_write import sync, write_atomically
from ldo_service.transport.interface import Transport

from .generations import KEEP_WITHIN_S, GenerationKeeper
from .stage_commands import CommandSender, What
from .supervision_policy import LOG_PERIOD_S, LogLimit

log = logging.getLogger(__name__)

# Minimum time that each actor has to reply to a command, seconds: three times the slowest step
# measured.
MIN_S = 2.0
# Time between two attempts to complete a reset that the previous process began, seconds.
COMPLETE_AGAIN_S = 2.0
# Time for all attempts to keep the empty states after a reset, and between two of them, seconds.
# A stage that is still writing the previous generation refuses to begin another one.
KEEP_FOR_S, KEEP_AGAIN_S = 2 * KEEP_WITHIN_S, 1.0


class ControlError(Exception):
    """Error of a command that some actors did not execute; its text names these actors."""


class Control:
    """Control interface of the whole service: pause, resume, save and reset."""

    def __init__(
        self,
        transport: Transport,
        actors: Sequence[str],
        sources: Sequence[str],
        saved_where: str,
        timeout_s: float,
        reset_marker: Path | None = None,
        pause_marker: Path | None = None,
        generations: GenerationKeeper | None = None,
    ) -> None:
        """Connect to the stages.

        Args:
            transport: The network.
            actors: Names of all actors, producers first.
            sources: Names of the actors with inputs from outside the service.
            saved_where: Description of the state folder, for replies.
            timeout_s: Time limit of a command for all actors together, seconds.
            reset_marker: File that exists while a reset is not complete; None: no file. If the
                previous process left it, this object completes the reset.
            pause_marker: File that exists while the service is paused; None: no file. If the
                previous process left it, this object pauses the sources.
            generations: Keeper of the generations of all states, which a reset replaces; None:
                there is none.
        """
        self._generations = generations
        self._reset_marker, self._pause_marker = reset_marker, pause_marker
        self._sender = CommandSender(transport)
        self._actors, self._sources = tuple(actors), tuple(sources)
        self._saved_where, self._timeout_s = saved_where, timeout_s
        self._is_paused = pause_marker is not None and pause_marker.exists()
        self._one_at_a_time = asyncio.Lock()
        self._tasks: set[asyncio.Task[object]] = set()
        self._verbs: dict[str, Callable[[], Awaitable[str]]] = {
            "pause": self._pause,
            "resume": self._resume,
            "save": self._save,
            "reset": self._reset,
        }
        self._is_reset_pending = reset_marker is not None and reset_marker.exists()
        if self._is_reset_pending:
            self._start(self._complete_reset())
        if self._is_paused:
            log.warning("The service is paused, as it was when it stopped: it drops frames. Run "
                        "`ldo control resume` to continue.")  # fmt: skip
        transport.watch_liveliness(self._presence)

    async def answer(self, body: bytes) -> bytes:
        """Execute an encoded `ControlRequest` and return the encoded `ControlAnswer`.

        If the bytes are malformed, the answer has the error.
        """
        try:
            request = decode(body, ControlRequest)
        except msgspec.DecodeError as error:
            return encode(_answer(0, False, f"malformed ControlRequest: {error}."))
        verb = self._verbs.get(request.command)
        if verb is None:
            known = ", ".join(self._verbs)
            text = f"unknown command {request.command[:40]!r}; this version has {known}."
            return encode(_answer(request.stamp_ns, False, text))
        async with self._one_at_a_time:
            try:
                ok, text = True, await verb()
            except ControlError as failed:
                ok, text = False, str(failed)
        log.log(logging.INFO if ok else logging.ERROR, "%s: %s", request.command, text)
        return encode(_answer(request.stamp_ns, ok, text))

    def close(self) -> None:
        """Close the publisher of commands."""
        for task in self._tasks:
            task.cancel()
        self._sender.close()

    # --- verbs ------------------------------------------------------------------------------------
    async def _pause(self) -> str:
        self._is_paused = True
        note = ""
        try:
            if self._pause_marker is not None:
                write_atomically(self._pause_marker, b"")
        except OSError as error:
            note = (
                f" A restart resumes the service too, because {self._pause_marker} cannot be "
                f"written: {error.strerror}."
            )
        await self._each("pause", self._sources)
        return f"frames are dropped and counted until `resume`.{note}"

    async def _resume(self) -> str:
        if self._is_reset_pending:
            raise ControlError(
                "the last reset is not complete, so the actors have states of two runs. Repeat "
                "`ldo control reset`."
            )
        self._is_paused = False
        note = ""
        try:
            if self._pause_marker is not None:
                self._pause_marker.unlink(missing_ok=True)
        except OSError as error:
            note = (
                f" A restart pauses the service again, because {self._pause_marker} cannot be "
                f"removed: {error.strerror}."
            )
        await self._each("resume", self._sources)
        return f"frames are processed again.{note}"

    async def _save(self) -> str:
        await self._each("save", self._actors)
        return f"{', '.join(self._actors)} saved in {self._saved_where}."

    async def _reset(self) -> str:
        if self._generations is None:
            return await self._reset_actors()
        async with self._generations.lock:
            return await self._reset_actors()

    async def _reset_actors(self) -> str:
        try:
            await self._each("pause", self._actors)
            await asyncio.to_thread(self._mark_reset)
            await self._each("reset", self._actors)
            await self._replace_generations()
            await asyncio.to_thread(self._remove_reset_marker)
        except ControlError as error:
            if not self._is_reset_pending:
                with suppress(ControlError):
                    await self._resume_actors()
                raise
            # The actors stay paused: some still have messages of the old run for the others.
            raise ControlError(
                f"{error} Frames are dropped until the reset is complete. A restart of the service "
                "also completes the reset."
            ) from error
        self._is_reset_pending = False
        await self._resume_actors()
        still = " Frames stay paused." if self._is_paused else ""
        return f"{', '.join(self._actors)} restarted with an empty state.{still}"

    async def _replace_generations(self) -> None:
        """Keep the empty states as a generation, so that no failure brings back the old map.

        Raises:
            ControlError: The states cannot be kept.
        """
        if self._generations is None:
            return
        until_s = time.monotonic() + KEEP_FOR_S
        while problem := await self._generations.keep(is_forced=True):
            if time.monotonic() >= until_s:
                break
            await asyncio.sleep(KEEP_AGAIN_S)
        else:
            return
        raise ControlError(
            "all actors are empty, but the older copy of their states on the disk cannot be "
            f"replaced: {problem}. A power cut could bring back the old map, because the service "
            "then falls back to this copy. If the disk is full, free some space. Then repeat the "
            "command."
        )

    async def _resume_actors(self) -> None:
        """Resume all actors, except the sources while the service is paused."""
        held = self._sources if self._is_paused else ()
        await self._each("resume", [actor for actor in self._actors if actor not in held])

    def _mark_reset(self) -> None:
        """Write the marker of an incomplete reset to the disk.

        Raises:
            ControlError: The disk is full or cannot be written. No actor was reset.
        """
        if self._reset_marker is not None:
            try:
                write_atomically(self._reset_marker, b"", syncs=True)
            except OSError as error:
                raise ControlError(
                    f"no actor was reset, because {self._reset_marker} cannot be written: "
                    f"{error.strerror}. Free some disk space, then repeat the command."
                ) from error
        self._is_reset_pending = True

    def _remove_reset_marker(self) -> None:
        """Remove the marker, because the next start would otherwise delete the new map.

        Raises:
            ControlError: The disk cannot be written.
        """
        if self._reset_marker is None:
            return
        try:
            self._reset_marker.unlink(missing_ok=True)
            sync(self._reset_marker.parent)
        except OSError as error:
            raise ControlError(
                f"all actors are empty, but {self._reset_marker} cannot be removed: "
                f"{error.strerror or error}. Check the disk, then repeat the command."
            ) from error

    async def _complete_reset(self) -> None:
        """Complete the reset that the previous process began, when all actors are running."""
        log.warning("completing the reset that the previous process of the service began; frames "
                    "are dropped until all actors have started.")  # fmt: skip
        failures = LogLimit(LOG_PERIOD_S)
        while self._is_reset_pending:
            async with self._one_at_a_time:
                try:
                    if self._is_reset_pending:
                        log.info("reset: %s", await self._reset())
                except ControlError as error:
                    if failures.is_due():
                        log.error("reset: %s The service tries again.", error)
                except Exception:  # If this task ended, frames would be dropped for good.
                    if failures.is_due():
                        log.exception("reset: an unexpected error; the service tries again. Please "
                                      "report the traceback.")  # fmt: skip
            await asyncio.sleep(COMPLETE_AGAIN_S)

    async def _each(self, what: What, actors: Sequence[str]) -> None:
        """Send a command to the actors, one after the other, and wait for each reply.

        The order matters for `pause`: a producer that waits for credit can finish its step only
        while its consumer is not paused. All actors together have `timeout_s` seconds to reply. If
        earlier actors have used up this time, each further actor still has `MIN_S` seconds, but not
        more than `timeout_s`.

        Raises:
            ControlError: Some actors did not execute the command. The error names them, and is
                raised after the command was sent to all actors.
        """
        failures, until_s = [], time.monotonic() + self._timeout_s
        for actor in actors:
            within_s = max(until_s - time.monotonic(), min(MIN_S, self._timeout_s))
            error = await self._sender.send(what, actor, within_s)
            failures += [f"{actor} {error}"] if error else []
        if failures:
            advice = "Check the actors with `ldo doctor`, then repeat the command."
            raise ControlError(f"some actors did not {what}: {'; '.join(failures)}. {advice}")

    # --- actors that were restarted ---------------------------------------------------------------
    def _presence(self, name: str, alive: bool) -> None:
        """Send a restarted actor the command that it may not have found on the disk."""
        if not alive or name not in self._actors:
            return
        is_source = name in self._sources
        markers = [self._reset_marker, *([self._pause_marker] if is_source else [])]
        if self._is_reset_pending or (is_source and self._is_paused):
            self._start(self._sender.send("pause", name, self._timeout_s))
        elif any(marker is not None and marker.exists() for marker in markers):
            # The disk did not remove the marker, so the actor has started paused.
            self._start(self._sender.send("resume", name, self._timeout_s))

    def _start(self, work: Coroutine[Any, Any, object]) -> None:
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


def _answer(stamp_ns: int, ok: bool, text: str) -> ControlAnswer:
    return ControlAnswer(stamp_ns=stamp_ns, ok=ok, message=text)
