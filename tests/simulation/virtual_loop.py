"""Event loop on a virtual clock, and the simulated processes that share it.

The loop never waits: if no callback is ready, its clock jumps to the next timer. All processes of
the simulation run in this one loop. Each callback belongs to the process that scheduled it, so the
loop can freeze a process (SIGSTOP) or kill it (SIGKILL) between any two callbacks.
"""

import asyncio
import heapq
import random
from collections import deque
from collections.abc import Callable, Coroutine
from contextvars import ContextVar, copy_context
from typing import Any

# Process that the current callback belongs to; None: the driver of the simulation.
CURRENT: ContextVar["Process | None"] = ContextVar("process", default=None)

KILLED = -9  # Exit code of a killed process.
# Maximum time that a function in a thread of the default executor waits for its turn, seconds.
THREAD_DELAY_S = 0.002


class KilledError(BaseException):
    """Error that ends the code of a dead process; not an Exception, so that no handler takes it."""


class Process:
    """Simulated process: a group of tasks that can be frozen and killed together."""

    _count = 1000

    def __init__(self, loop: "VirtualLoop", name: str) -> None:
        """Create a process without tasks.

        Args:
            loop: The event loop of all processes.
            name: Name of the process, such as "service" or the name of its actor.
        """
        self.name, self._loop = name, loop
        loop.processes += 1
        self.pid = Process._count + loop.processes
        self.is_dead = self.is_frozen = False
        self.exit_code: int | None = None
        self.ended = asyncio.Event()
        self.on_end: list[Callable[[], None]] = []
        self.tasks: list[asyncio.Task[Any]] = []
        self.held: deque[asyncio.Handle] = deque()  # Callbacks that wait while it is frozen.
        # Number of callbacks, and of disk operations, after which it is killed.
        self.kill_after_callbacks: int | None = None
        self.kill_after_disk_operations: int | None = None
        self.context = copy_context()
        self.context.run(CURRENT.set, self)

    def start(self, main: Coroutine[Any, Any, None]) -> None:
        """Run `main` as the first task; the process ends with it."""
        task = self._loop.create_task(main, context=self.context)
        task.add_done_callback(self._main_ended)

    def _main_ended(self, task: asyncio.Task[None]) -> None:
        if not self.is_dead:
            error = None if task.cancelled() else task.exception()
            self.end(0 if error is None else getattr(error, "exit_code", 1))
            if error is not None and not hasattr(error, "exit_code"):
                self._loop.errors.append(f"{self.name} ended: {error!r}")

    def end(self, exit_code: int) -> None:
        """End the process now.

        Its tasks are cancelled. Their cleanup has no effect, because neither the disk nor the
        network takes anything from a dead process.
        """
        if self.is_dead:
            return
        self.is_dead, self.exit_code = True, exit_code
        for task in self.tasks:
            task.cancel()
        for on_end in self.on_end:
            on_end()
        self.thaw()
        self.ended.set()

    def kill(self) -> None:
        """Kill the process (SIGKILL)."""
        self.end(KILLED)

    def freeze(self) -> None:
        """Stop the process (SIGSTOP) until `thaw`."""
        self.is_frozen = not self.is_dead

    def thaw(self) -> None:
        """Continue the process (SIGCONT)."""
        self.is_frozen = False
        self._loop.release(self.held)

    def count_callback(self) -> None:
        """Count a callback, and kill the process if its time has come."""
        if self.kill_after_callbacks is not None:
            self.kill_after_callbacks -= 1
            if self.kill_after_callbacks < 0:
                self.kill_after_callbacks = None
                self.kill()

    def count_disk_operation(self) -> None:
        """Count an operation on the disk, and kill the process if its time has come.

        Raises:
            KilledError: The process is dead.
        """
        if self.kill_after_disk_operations is not None:
            self.kill_after_disk_operations -= 1
            if self.kill_after_disk_operations < 0:
                self.kill_after_disk_operations = None
                self.kill()
        if self.is_dead:
            raise KilledError


def is_current_dead() -> bool:
    """Return whether the current callback belongs to a dead process."""
    process = CURRENT.get()
    return process is not None and process.is_dead


class VirtualLoop(asyncio.BaseEventLoop):
    """Event loop whose time passes only while no callback is ready.

    Attributes:
        errors: Exceptions that no task has handled.
        callbacks: Number of callbacks run so far.
    """

    # Attributes of `BaseEventLoop` that `_run_once` uses.
    _ready: deque[asyncio.Handle]
    _scheduled: list[asyncio.TimerHandle]

    def __init__(self, seed: int) -> None:
        """Initialize at time 0.

        Args:
            seed: Seed of the durations of functions in threads.
        """
        super().__init__()
        self._now_s, self._rng = 0.0, random.Random(f"{seed} threads")
        self.errors: list[str] = []
        self.callbacks = self.processes = 0
        self.set_task_factory(_task_of_process)  # type: ignore[arg-type]
        self.set_exception_handler(self._note_error)

    def time(self) -> float:
        """Return the virtual time in seconds."""
        return self._now_s

    def run_in_executor(self, executor: Any, func: Any, *args: Any) -> Any:  # noqa: ARG002
        """Call a function after a random delay, and return the future of its result."""
        future = self.create_future()

        def call() -> None:
            if future.cancelled() or is_current_dead():
                return
            try:
                result = func(*args)
            except KilledError:
                return
            except Exception as error:
                future.set_exception(error)
            else:
                future.set_result(result)

        self.call_later(self._rng.uniform(0.0, THREAD_DELAY_S), call)
        return future

    def release(self, handles: deque[asyncio.Handle]) -> None:
        """Run the callbacks of a process that was frozen."""
        self._ready.extend(handles)
        handles.clear()

    def _note_error(self, _loop: Any, context: dict[str, Any]) -> None:
        error = context.get("exception")
        if not isinstance(error, KilledError) and not is_current_dead():
            self.errors.append(f"{context.get('message')}: {error!r}")

    def _write_to_self(self) -> None:
        """Do nothing: the loop never waits, so no thread has to wake it."""

    def _run_once(self) -> None:
        scheduled, ready = self._scheduled, self._ready
        while scheduled and scheduled[0]._cancelled:
            heapq.heappop(scheduled)._scheduled = False
        if not ready:
            if not scheduled:
                raise RuntimeError("deadlock: no callback is ready and no timer is set")
            self._now_s = max(self._now_s, scheduled[0]._when)
        while scheduled and scheduled[0]._when <= self._now_s:
            timer = heapq.heappop(scheduled)
            timer._scheduled = False
            if not timer._cancelled:
                ready.append(timer)
        for _ in range(len(ready)):
            handle = ready.popleft()
            if handle._cancelled:
                continue
            process = handle._context.get(CURRENT)
            if process is not None:
                if process.is_frozen:
                    process.held.append(handle)
                    continue
                process.count_callback()
            self.callbacks += 1
            handle._run()


def _task_of_process(
    loop: VirtualLoop, coroutine: Coroutine[Any, Any, Any], **options: Any
) -> asyncio.Task[Any]:
    """Create a task that ends with the current process."""
    task = asyncio.Task(coroutine, loop=loop, **options)
    context = options.get("context")
    process = context.get(CURRENT) if context is not None else CURRENT.get()
    if process is not None:
        process.tasks.append(task)
        if process.is_dead:
            task.cancel()
    return task
