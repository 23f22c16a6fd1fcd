"""pause, resume, save, reset: one answer for the whole service, when all its actors have obeyed.

`reset` first holds every actor, producers first, so that nothing of the old run is under way when
they begin anew: a late correction of 50 keyframes would outdate the first one of the new run.
"""

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Sequence

import msgspec

from ldo_service.runtime.orders import Commander, What
from ldo_service.runtime.transport import Transport
from ldo_service.schemas import ControlAnswer, ControlRequest, decode, encode

log = logging.getLogger(__name__)

LEAST_S = 2.0  # 3x the slowest step measured


class ControlFailed(Exception):
    """Some actor did not obey; the text names it."""


class Control:
    """`actors` in the order of the data, producers first; `sources` are those fed from outside."""

    def __init__(
        self,
        transport: Transport,
        actors: Sequence[str],
        sources: Sequence[str],
        saved_where: str,
        timeout_s: float,
    ) -> None:
        self._commander = Commander(transport)
        self._actors, self._sources = tuple(actors), tuple(sources)
        self._saved_where, self._timeout_s = saved_where, timeout_s
        self._is_paused = False
        self._one_at_a_time = asyncio.Lock()
        self._tasks: set[asyncio.Task[str]] = set()
        self._verbs: dict[str, Callable[[], Awaitable[str]]] = {
            "pause": self._pause,
            "resume": self._resume,
            "save": self._save,
            "reset": self._reset,
        }
        transport.watch(self._presence)

    async def answer(self, body: bytes) -> bytes:
        """The reply to a query's payload, whatever the bytes are."""
        try:
            request = decode(body, ControlRequest)
        except msgspec.DecodeError as error:
            return encode(_answer(0, False, f"this is no ControlRequest: {error}."))
        verb = self._verbs.get(request.verb)
        if verb is None:
            known = ", ".join(self._verbs)
            text = f"there is no {request.verb[:40]!r} in this version. There are {known}."
            return encode(_answer(request.stamp_ns, False, text))
        async with self._one_at_a_time:
            try:
                ok, text = True, await verb()
            except ControlFailed as failed:
                ok, text = False, str(failed)
        log.log(logging.INFO if ok else logging.ERROR, "%s: %s", request.verb, text)
        return encode(_answer(request.stamp_ns, ok, text))

    def close(self) -> None:
        self._commander.close()

    # --- verbs ------------------------------------------------------------------------------------
    async def _pause(self) -> str:
        self._is_paused = True
        await self._each("hold", self._sources)
        return "frames are left out and counted until `resume`."

    async def _resume(self) -> str:
        self._is_paused = False
        await self._each("release", self._sources)
        return "frames are taken again."

    async def _save(self) -> str:
        await self._each("save", self._actors)
        return f"{', '.join(self._actors)} saved in {self._saved_where}."

    async def _reset(self) -> str:
        try:
            await self._each("hold", self._actors)
            await self._each("renew", self._actors)
        finally:
            held = self._sources if self._is_paused else ()
            await self._each("release", [actor for actor in self._actors if actor not in held])
        still = " Frames stay paused." if self._is_paused else ""
        return f"{', '.join(self._actors)} began anew.{still}"

    async def _each(self, what: What, actors: Sequence[str]) -> None:
        """One after the other: a producer may have to wait for a consumer that is not held yet. All
        have `timeout_s` together, and who comes after one that hangs a moment at least.

        Raises ControlFailed, after all have been told, naming those that did not obey.
        """
        failures, until_s = [], time.monotonic() + self._timeout_s
        for actor in actors:
            within_s = max(until_s - time.monotonic(), min(LEAST_S, self._timeout_s))
            error = await self._commander.order(what, actor, within_s)
            failures += [f"{actor} {error}"] if error else []
        if failures:
            advice = "`ldo doctor` shows how the actors are; then ask again."
            raise ControlFailed(f"could not {what} all actors: {'; '.join(failures)}. {advice}")

    # --- actors that were restarted ---------------------------------------------------------------
    def _presence(self, name: str, alive: bool) -> None:
        """A process that comes back does not know of the pause."""
        if alive and self._is_paused and name in self._sources:
            task = asyncio.ensure_future(self._commander.order("hold", name, self._timeout_s))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)


def _answer(stamp_ns: int, ok: bool, text: str) -> ControlAnswer:
    return ControlAnswer(stamp_ns=stamp_ns, ok=ok, text=text)
