"""Runs of the whole runtime on a virtual clock, with faults drawn from a seed.

    .venv/bin/python -m tests.simulation.simulation --seeds 1000 --first 0
    .venv/bin/python -m tests.simulation.simulation --first 17 --seeds 1 --verbose

The method is that of TigerBeetle's VOPR. The same seed at the same commit repeats the same run.
"""

import argparse
import asyncio
import logging
import sys
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from ldo_service.schemas import decode, encode
from ldo_service.transport.flow_control import (
    Credit,
    Header,
    ProducerHello,
    credit_key,
    decode_request,
    encode_link,
    producer_hello_key,
    retransmit_key,
)
from tests.faults.message_recorder import MessageRecorder

from .actors import CAMERA, GRAPH, TOPICS, Position, links, note
from .faults import Faults
from .service import Machine
from .virtual_loop import VirtualLoop

FRAME_S = 0.6  # Time between two frames of the camera, each of which is a keyframe, seconds.
# Time after the end of all faults in which every link must pass on a new message, and time after
# the last frame in which every message must be handled, seconds.
ALIVE_WITHIN_S = DRAINED_WITHIN_S = 10.0
KEYFRAMES = "keyframe/new"
VERSIONED = ("graph/correction", "map/delta")  # Topics with a version that must grow.


@dataclass
class Report:
    """Result of a run."""

    seed: int
    violations: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    digest: int = 0  # Checksum of all messages with their times.
    virtual_s: float = 0.0
    recovery_s: float = 0.0  # Time from the end of all faults to a new message on each link.
    # Time from the end of all faults to a message on each link between two hosts, and maximum time
    # between two poses; measured by `two_hosts` only.
    resumed_s: float = 0.0
    pose_gap_s: float = 0.0
    callbacks: int = 0
    keyframes: int = 0


class Simulation:
    """One run."""

    alive_within_s = ALIVE_WITHIN_S  # A subclass may replace it.

    def __init__(
        self, loop: VirtualLoop, seed: int, only: Sequence[str] = (), remote: Sequence[str] = ()
    ) -> None:
        self._loop = loop
        self.report = Report(seed)
        self._machine = Machine(loop, seed, self._violation, self._observe, remote)
        self._faults = Faults(self._machine, seed, only)
        self._machine.on_lost_state = self._forget
        self._recorders: dict[int, MessageRecorder] = {}
        self._epoch = 0  # Present epoch of the keyframes.
        self._versions: dict[tuple[str, int], int] = {}  # Last version, by topic and epoch.
        self._is_camera_on = True

    def _violation(self, text: str) -> None:
        self.report.violations.append(f"{self._loop.time():.3f} {text}")

    # --- messages -------------------------------------------------------------------------------
    def _observe(self, key: str, header: bytes, body: bytes) -> None:
        """Check a message when it is sent."""
        digest = zlib.crc32(f"{self._loop.time():.9f} {key}".encode(), self.report.digest)
        self.report.digest = zlib.crc32(body, zlib.crc32(header, digest))
        if key == credit_key(KEYFRAMES):
            credit = decode_request(memoryview(body))
            # A hello of the time before a reset, which others overtook, may still be answered.
            if isinstance(credit, Credit) and credit.epoch == self._epoch:
                self._check(credit.epoch, lambda recorder: recorder.add_credit(credit))
        elif key == producer_hello_key(KEYFRAMES):
            self._epoch = decode(body, ProducerHello).epoch
        elif key.startswith((KEYFRAMES, retransmit_key(KEYFRAMES))):
            message: Any = decode(body, TOPICS[KEYFRAMES].message)
            sent = decode(header, Header)
            self._check(sent.epoch, lambda recorder: recorder.add_keyframe(message, sent, body))
        elif key in VERSIONED:
            versioned: Any = decode(body, TOPICS[key].message)
            version, sent = versioned.number, decode(header, Header)
            before = self._versions.get((key, sent.epoch), -1)
            self._check(sent.epoch, lambda recorder: recorder.must_grow(key, before, version))
            self._versions[key, sent.epoch] = version

    def _check(self, epoch: int, check: Callable[[MessageRecorder], None]) -> None:
        """Call a check of the recorder of an epoch, and report what it finds."""
        recorder = self._recorders.setdefault(epoch, MessageRecorder())
        check(recorder)
        for violation in recorder.violations:
            self._violation(violation)
        recorder.violations.clear()

    def _forget(self) -> None:
        """Forget all messages, because the service may have fallen back to older states."""
        self._recorders.clear()
        self._versions.clear()

    # --- run ------------------------------------------------------------------------------------
    async def run(self) -> None:
        """Run the service, inject the faults, and check that it recovers."""
        machine = self._machine
        with machine.running():
            running = asyncio.create_task(machine.run())
            camera = asyncio.create_task(self._film())
            try:
                await self._faults.inject()
                await self._faults.heal()
                await self._check_alive()
                self._is_camera_on = False
                await camera
                await self._check_drained()
            finally:
                await self._end(running)

    async def _end(self, running: asyncio.Task[None]) -> None:
        """Kill all processes, cancel all tasks, and complete the report."""
        machine = self._machine
        running.cancel()
        for process in list(machine.processes.values()):
            process.kill()
        self.report.faults += self._faults.done + machine.failures
        self.report.violations += self._loop.errors
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)
        self.report.virtual_s, self.report.callbacks = self._loop.time(), self._loop.callbacks

    async def _film(self) -> None:
        """Send frames; their digest is a random number that identifies what the camera saw."""
        publisher = self._machine.network.transport("camera").publisher(CAMERA.name)
        number = 0
        while self._is_camera_on:
            stamp_ns = round(self._loop.time() * 1e9)
            nonce = self._machine.rng.getrandbits(31)
            frame = note(CAMERA.name, stamp_ns, Position(number), nonce)
            publisher.post(encode_link(Header("camera", 1, number, stamp_ns)), encode(frame))
            number += 1
            await asyncio.sleep(FRAME_S)

    # --- checks ---------------------------------------------------------------------------------
    async def _check_alive(self) -> None:
        """Wait until every link has passed on a message of a frame after the end of all faults.

        The time that systemd waits before it starts a failed service again does not count.
        """
        while self._machine.is_waiting:
            await asyncio.sleep(0.1)
        healed_s = self._loop.time()
        recovering = asyncio.create_task(self._recover())
        while True:
            await asyncio.sleep(0.1)
            stuck = [
                f"{consumer.name} handles no new {port.topic.name}"
                for _, _, consumer, port in links()
                if self._stamp_ns(consumer.name, port.topic.name) < healed_s * 1e9
            ]
            after_s = self._loop.time() - healed_s
            if not stuck:
                self.report.recovery_s = after_s
                break
            if after_s > self.alive_within_s:
                self._violation(f"{after_s:.1f} s after the last fault: {'; '.join(stuck)}")
                break
        recovering.cancel()

    async def _recover(self) -> None:
        """Repeat the commands that a user repeats after their failure."""
        while True:
            if self._faults.is_reset_wanted:
                answer = await self._machine.command("reset")
                self._faults.is_reset_wanted = answer is None or not answer.ok
            else:
                answer = await self._machine.command("resume")
                if answer and answer.ok:
                    return
            await asyncio.sleep(0.1)

    def _stamp_ns(self, actor: str, topic: str) -> int:
        found = self._machine.actors.get(actor)
        return found.stamps_ns.get(topic, 0) if found else 0

    async def _check_drained(self) -> None:
        """Wait until every consumer has handled every message."""
        until_s = self._loop.time() + DRAINED_WITHIN_S
        while missing := self._unhandled():
            if self._loop.time() > until_s:
                self._violation(f"{DRAINED_WITHIN_S:.0f} s after the last frame: {missing}")
                return
            await asyncio.sleep(0.1)
        made = self._machine.actors["tracker"].made.get(KEYFRAMES, Position())
        self.report.keyframes = made.number

    def _unhandled(self) -> str:
        actors = self._machine.actors
        if len(actors) < len(GRAPH):
            return "some actors have never started"
        missing = []
        for producer, out, consumer, _ in links():
            topic = out.topic.name
            made = actors[producer.name].made.get(topic, Position())
            taken = actors[consumer.name].taken.get(topic, Position())
            if made != taken:
                missing.append(f"{consumer.name} has {taken.number} of {made.number} on {topic}")
        return "; ".join(missing)


def simulate(seed: int, only: Sequence[str] = ()) -> Report:
    """Run one seed.

    Args:
        seed: Seed of the faults, delays and durations.
        only: Kinds of faults to draw from; empty for all.

    Returns:
        The report, with all violated invariants.
    """
    loop = VirtualLoop(seed)
    simulation = Simulation(loop, seed, only)
    try:
        loop.run_until_complete(simulation.run())
    finally:
        loop.close()
    return simulation.report


def _add_virtual_time(record: logging.LogRecord) -> bool:
    record.virtual_s = time.monotonic()
    return True


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--verbose", action="store_true")
    given = parser.parse_args()
    if given.verbose:
        handler = logging.StreamHandler(sys.stdout)
        handler.addFilter(_add_virtual_time)
        logging.basicConfig(
            level=logging.INFO, format="%(virtual_s)8.3f %(message)s", handlers=[handler]
        )
    else:
        logging.disable(logging.CRITICAL)
    started_s, failed, virtual_s = time.process_time(), 0, 0.0
    recovery_s: list[float] = []
    for seed in range(given.first, given.first + given.seeds):
        report = simulate(seed)
        virtual_s += report.virtual_s
        recovery_s.append(report.recovery_s)
        if report.violations or given.verbose:
            failed += bool(report.violations)
            print(f"seed {seed}: {report}", flush=True)
    took_s = time.process_time() - started_s
    print(
        f"{given.seeds} seeds in {took_s:.1f} s of CPU ({given.seeds / took_s:.1f} per second), "
        f"{virtual_s:.0f} virtual seconds, {failed} with violations, recovery at most "
        f"{max(recovery_s):.1f} s"
    )
    raise SystemExit(failed > 0)


if __name__ == "__main__":
    main()
