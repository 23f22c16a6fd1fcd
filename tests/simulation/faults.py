"""Faults of a simulated run, drawn from its seed."""

import asyncio
import random
from collections.abc import Awaitable, Callable, Sequence

from .actors import NAMES
from .network import Disturbance
from .service import Machine

# Time of the first fault, and time after which no fault begins, seconds.
FIRST_S, LAST_S = 3.0, 11.0
FAULTS = (2, 5)  # Number of faults of a run.
# Faults that may end a process. A message during whose handling three processes end is set aside by
# design, so a run has at most two of them.
DEADLY = ("kill child", "kill service", "power cut", "flipped bit", "hang", "stop", "freeze")
MAX_DEADLY = 2
DAMAGING = ("flipped bit", "power cut")  # Faults that damage a saved state.
HANG_S = 8.0  # Duration of a hanging step, longer than the step timeout of the service, seconds.
# Maximum number of callbacks, and of disk operations, from a random time until the kill.
MAX_CALLBACKS, MAX_DISK_OPERATIONS = 60, 60
LOSSY_TOPICS = ("keyframe/new", "detection/boxes", "label/result", "label/request")


class Faults:
    """Faults of one run.

    Attributes:
        done: Description of each fault, with its time.
        is_reset_wanted: Whether a reset has begun that no reply has confirmed.
    """

    def __init__(self, machine: Machine, seed: int, only: Sequence[str] = ()) -> None:
        """Prepare the faults; `inject` draws them.

        Args:
            machine: The machine.
            seed: Seed of kinds and times.
            only: Kinds of faults to draw from; empty for all.
        """
        self._machine, self._rng = machine, random.Random(f"{seed} faults")
        self._kinds: dict[str, Callable[[], Awaitable[None]]] = {
            "loss": self._loss,
            "delay": self._delay,
            "partition": self._partition,
            "kill child": self._kill_child,
            "kill service": self._kill_service,
            "power cut": self._cut_power,
            "flipped bit": self._flip_bit,
            "freeze": self._freeze,
            "reset": self._reset,
            "pause": self._pause,
            "save": self._save,
            "stop": self._stop,
            "full disk": self._fill_disk,
            "bad disk": self._break_disk,
            "failure": self._fail,
            "failure after save": self._fail_after_save,
            "slow": self._slow,
            "hang": self._hang,
        }
        self._only = only or list(self._kinds)
        self.done: list[str] = []
        self.is_reset_wanted = False

    async def inject(self) -> None:
        """Inject the faults of the run; each one ends before this method returns."""
        rng = self._rng
        kinds: list[str] = []
        for _ in range(rng.randint(*FAULTS)):
            kind = rng.choice(self._only)
            is_bearable = kind not in DEADLY or sum(k in DEADLY for k in kinds) < MAX_DEADLY
            # A flipped bit may be in the only older generation, which another damage needs.
            damages = [k for k in (*kinds, kind) if k in DAMAGING]
            if is_bearable and not ("flipped bit" in damages and len(damages) > 1):
                kinds.append(kind)
        times_s = sorted(rng.uniform(FIRST_S, LAST_S) for _ in kinds)
        tasks = []
        for at_s, kind in zip(times_s, kinds, strict=True):
            await asyncio.sleep(at_s - self._machine.loop.time())
            self._note(kind)
            tasks.append(asyncio.create_task(self._inject(kind)))
        if tasks:
            await asyncio.wait(tasks)
        for task in tasks:
            task.result()

    async def _inject(self, kind: str) -> None:
        await self._kinds[kind]()

    def _note(self, what: str) -> None:
        self.done.append(f"{self._machine.loop.time():.3f} {what}")

    async def heal(self) -> None:
        """End all faults, and let the service take frames again."""
        machine = self._machine
        machine.network.heal()
        machine.disk.is_full, machine.disk.error_probability = False, 0.0
        machine.slow_s.clear()
        machine.hang_s.clear()
        await asyncio.sleep(max(0.0, machine.hangs_until_s - machine.loop.time()))
        for process in machine.processes.values():
            process.thaw()
            process.kill_after_callbacks = process.kill_after_disk_operations = None
        self._note("healed")

    # --- network --------------------------------------------------------------------------------
    def _process(self) -> str:
        return self._rng.choice(["service", *self._machine.children])

    async def _disturb(self, disturbance: Disturbance, longest_s: float) -> None:
        disturbances = self._machine.network.disturbances
        disturbances.append(disturbance)
        await asyncio.sleep(self._rng.choice([longest_s / 8, longest_s / 3, longest_s]))
        if disturbance in disturbances:
            disturbances.remove(disturbance)

    async def _loss(self) -> None:
        rng = self._rng
        disturbance = Disturbance(
            source=rng.choice(["", self._process()]),
            target=rng.choice(["", self._process()]),
            topic=rng.choice(["", rng.choice(LOSSY_TOPICS)]),
            loss=rng.choice([0.05, 0.3, 1.0]),
        )
        await self._disturb(disturbance, 11.0)

    async def _delay(self) -> None:
        rng = self._rng
        disturbance = Disturbance(
            source=rng.choice(["", self._process()]),
            delay_s=rng.choice([0.05, 0.5, 2.0]),
            duplication=rng.choice([0.0, 0.2]),
            reorders=rng.random() < 0.5,
        )
        await self._disturb(disturbance, 5.0)

    async def _partition(self) -> None:
        name = self._process()
        self._machine.network.partition(name)
        await asyncio.sleep(self._rng.choice([0.5, 3.0, 6.0, 12.0]))
        self._machine.network.heal()

    # --- processes ------------------------------------------------------------------------------
    def _kill_soon(self, name: str) -> None:
        process, rng = self._machine.processes.get(name), self._rng
        if process is not None:
            if rng.random() < 0.5:
                process.kill_after_callbacks = rng.randrange(MAX_CALLBACKS)
            else:
                process.kill_after_disk_operations = rng.randrange(MAX_DISK_OPERATIONS)

    async def _kill_child(self) -> None:
        self._kill_soon(self._process())

    async def _kill_service(self) -> None:
        self._kill_soon("service")

    async def _cut_power(self) -> None:
        """Cut the power after some disk operations of any process."""
        machine = self._machine
        last = machine.disk.operations + self._rng.randrange(MAX_DISK_OPERATIONS)
        off_s = self._rng.uniform(0.5, 2.0)
        until_s = machine.loop.time() + 1.0
        while machine.disk.operations < last and machine.loop.time() < until_s:
            await asyncio.sleep(0.001)
        machine.cut_power(off_s)
        await asyncio.sleep(off_s)

    async def _flip_bit(self) -> None:
        self._machine.processes["service"].kill()
        for child in self._machine.children:
            if process := self._machine.processes.get(child):
                process.kill()
        self._note(f"flipped a bit of {self._machine.disk.flip_bit()}")
        self._machine.on_lost_state()

    async def _freeze(self) -> None:
        rng, machine = self._rng, self._machine
        names = [self._process()]
        if rng.random() < 0.3:
            names = ["service", *machine.children]
        frozen = [machine.processes[name] for name in names if name in machine.processes]
        for process in frozen:
            process.freeze()
        await asyncio.sleep(rng.choice([0.5, 3.0, 7.0]))
        for process in frozen:
            process.thaw()

    async def _slow(self) -> None:
        actor = self._rng.choice(NAMES)
        self._machine.slow_s[actor] = self._rng.choice([0.05, 0.3, 1.0])
        await asyncio.sleep(self._rng.uniform(1.0, 4.0))
        self._machine.slow_s.pop(actor, None)

    async def _hang(self) -> None:
        self._machine.hang_s[self._rng.choice(NAMES)] = HANG_S

    async def _fail(self) -> None:
        self._machine.failing.add(self._rng.choice(NAMES))

    async def _fail_after_save(self) -> None:
        self._machine.failing_after_save.add(self._rng.choice(NAMES))

    # --- disk -----------------------------------------------------------------------------------
    async def _fill_disk(self) -> None:
        self._machine.disk.is_full = True
        await asyncio.sleep(self._rng.uniform(0.5, 5.0))
        self._machine.disk.is_full = False

    async def _break_disk(self) -> None:
        self._machine.disk.error_probability = self._rng.choice([0.02, 0.3])
        await asyncio.sleep(self._rng.uniform(0.5, 4.0))
        self._machine.disk.error_probability = 0.0

    # --- commands -------------------------------------------------------------------------------
    async def _reset(self) -> None:
        self.is_reset_wanted = True
        rng = self._rng
        if rng.random() < 0.6:
            victim = rng.choice(["service", self._process()])
            asyncio.get_running_loop().call_later(rng.uniform(0.0, 0.1), self._kill_soon, victim)
        answer = await self._machine.command("reset")
        self.is_reset_wanted = answer is None or not answer.ok

    async def _pause(self) -> None:
        await self._machine.command("pause")
        await asyncio.sleep(self._rng.uniform(0.1, 2.0))
        await self._machine.command("resume")

    async def _save(self) -> None:
        await self._machine.command("save")

    async def _stop(self) -> None:
        self._machine.stop()
