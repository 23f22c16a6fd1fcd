"""Runs on a virtual clock with actors on another host, behind a bad network.

    .venv/bin/python -m tests.simulation.two_hosts --seeds 200 --first 0

A seed draws the remote actors, and for 30 to 300 s a loss of 1 to 20 % of all messages between the
hosts, a delay of 50 to 500 ms, and partitions, most of them in one direction. The service takes
frames all the time. The network then heals.
"""

import argparse
import asyncio
import logging
import random
import time

from ldo_service.transport.flow_control import data_key

from .actors import Position, links
from .network import Disturbance, Way
from .simulation import Report, Simulation
from .virtual_loop import VirtualLoop

ALWAYS = ("optimizer", "detector", "vlm_labeller")  # Remote actors of each run.
# Further remote actors of some runs. The configuration of the service allows all but the mapper.
SOMETIMES = ((), ("loop_closer",), ("mapper",), ("loop_closer", "mapper"))
START_S = 5.0  # Time of the service to start before the network becomes bad, seconds.
DURATION_S = (30.0, 300.0)  # Duration of the bad network; short ones are more frequent, seconds.
LOSS, DELAY_S = (0.01, 0.2), (0.05, 0.5)
BETWEEN_S, CUT_S = (2.0, 30.0), (1.0, 40.0)  # Time between two partitions, and duration of one.
WAYS = ((Way.OUT,), (Way.BACK,), (Way.OUT, Way.BACK))
RESUMED_WITHIN_S = 5.0
# A link first passes on the messages that waited, up to 140 keyframes of the optimizer: 11 s.
ALIVE_WITHIN_S = 15.0
MAX_POSE_GAP_S = 2.0  # The camera sends a frame every 0.6 s.
POSES = data_key("pose/tracked")


class TwoHosts(Simulation):
    """One run with two hosts."""

    alive_within_s = ALIVE_WITHIN_S

    def __init__(self, loop: VirtualLoop, seed: int, max_duration_s: float) -> None:
        self._rng, self._max_duration_s = random.Random(f"{seed} hosts"), max_duration_s
        remote = (*ALWAYS, *self._rng.choice(SOMETIMES))
        super().__init__(loop, seed, remote=remote)
        self.report.faults.append(f"remote: {', '.join(remote)}")
        self._crossing = [
            (producer.name, consumer.name, port.topic.name)
            for producer, _, consumer, port in links()
            if (producer.name in remote) != (consumer.name in remote)
        ]
        self._last_pose_s: float | None = None
        self._are_poses_watched = False

    def _observe(self, key: str, header: bytes, body: bytes) -> None:
        super()._observe(key, header, body)
        if key == POSES:
            self._watch_pose()

    def _watch_pose(self) -> None:
        """Note the time since the last pose."""
        now_s = self._loop.time()
        if self._are_poses_watched and self._last_pose_s is not None:
            gap_s = now_s - self._last_pose_s
            self.report.pose_gap_s = max(self.report.pose_gap_s, gap_s)
        self._last_pose_s = now_s

    async def _disturb(self) -> None:
        """Let the network be bad for a while, and then heal it."""
        rng, network = self._rng, self._machine.network
        await asyncio.sleep(START_S)
        self._are_poses_watched = True
        longer_s = (self._max_duration_s - DURATION_S[0]) * rng.random() ** 2
        until_s = START_S + DURATION_S[0] + longer_s
        loss, delay_s = rng.uniform(*LOSS), rng.uniform(*DELAY_S)
        ways = frozenset(Way)
        network.disturbances.append(
            Disturbance(ways=ways, loss=loss, min_delay_s=0.8 * delay_s, delay_s=delay_s)
        )
        self.report.faults.append(f"until {until_s:.0f} s: loss {loss:.3f}, delay {delay_s:.3f} s")
        while (now_s := self._loop.time()) < until_s:
            await asyncio.sleep(min(rng.uniform(*BETWEEN_S), until_s - now_s))
            cut = rng.choice(WAYS)
            cut_s = min(rng.uniform(*CUT_S), until_s - self._loop.time())
            self.report.faults.append(f"{self._loop.time():.3f} cut for {cut_s:.3f} s: {cut}")
            network.cut_hosts(cut)
            await asyncio.sleep(cut_s)
            if rng.random() < 0.5 or self._loop.time() < until_s:
                network.join_hosts()
        network.heal()
        network.join_hosts()

    async def _check_resumed(self) -> None:
        """Check that each link between the hosts passes on a message that was not handled.

        The message is one that waited at the end of the bad network, or one made since then.
        """
        healed_s = now_s = self._loop.time()
        stuck: list[str] = []
        before = {link: self._counts(*link) for link in self._crossing}
        while now_s - healed_s < RESUMED_WITHIN_S:
            await asyncio.sleep(0.05)
            now_s = self._loop.time()
            stuck = [
                f"{consumer} handles no {topic} of {producer}"
                for (producer, consumer, topic), (made, taken) in before.items()
                if (made > taken or self._counts(producer, consumer, topic)[0] > made)
                and self._counts(producer, consumer, topic)[1] == taken
            ]
            if stuck:
                self.report.resumed_s = now_s - healed_s
        if stuck:
            self._violation(f"{RESUMED_WITHIN_S:g} s after healing: {'; '.join(stuck)}")

    def _counts(self, producer: str, consumer: str, topic: str) -> tuple[int, int]:
        """Return the number of messages made, and of messages handled."""
        actors, none = self._machine.actors, Position()
        made = actors[producer].made.get(topic, none).number
        return made, actors[consumer].taken.get(topic, none).number

    async def run(self) -> None:
        """Run the service with a bad network, and check that the links continue."""
        with self._machine.running():
            running = asyncio.create_task(self._machine.run())
            camera = asyncio.create_task(self._film())
            try:
                await self._disturb()
                alive = asyncio.create_task(self._check_alive())
                await self._check_resumed()
                await alive
                self._watch_pose()
                if self.report.pose_gap_s > MAX_POSE_GAP_S:
                    self._violation(f"no pose for {self.report.pose_gap_s:.1f} s")
                self._is_camera_on = False
                await camera
                await self._check_drained()
                if self._machine.failures:
                    self._violation(f"the service ended: {self._machine.failures}")
            finally:
                await self._end(running)


def simulate(seed: int, max_duration_s: float = DURATION_S[1]) -> Report:
    """Run one seed.

    Args:
        seed: Seed of the remote actors and of the faults of the network.
        max_duration_s: Maximum duration of the bad network, seconds.

    Returns:
        The report, with all violated invariants.
    """
    loop = VirtualLoop(seed)
    simulation = TwoHosts(loop, seed, max_duration_s)
    try:
        loop.run_until_complete(simulation.run())
    finally:
        loop.close()
    return simulation.report


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args()
    logging.disable(logging.CRITICAL)
    started_s = time.process_time()
    reports = []
    for seed in range(given.first, given.first + given.seeds):
        reports.append(simulate(seed))
        if reports[-1].violations:
            print(f"seed {seed}: {reports[-1]}", flush=True)
    took_s = time.process_time() - started_s
    failed = sum(bool(report.violations) for report in reports)
    print(
        f"{given.seeds} seeds in {took_s:.1f} s of CPU, "
        f"{sum(r.virtual_s for r in reports):.0f} virtual seconds, "
        f"{sum(r.keyframes for r in reports)} keyframes, {failed} with violations. At most: "
        f"{max(r.resumed_s for r in reports):.1f} s until each link passes on a message, "
        f"{max(r.recovery_s for r in reports):.1f} s until it passes on one of a new frame, "
        f"{max(r.pose_gap_s for r in reports):.1f} s between two poses"
    )
    raise SystemExit(failed > 0)


if __name__ == "__main__":
    main()
