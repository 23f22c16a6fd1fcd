"""Handling of Ctrl-C that lets a running step finish."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def interrupts_delayed() -> Iterator[None]:
    """Delay Ctrl-C until the end of the `with` block, so that the step in the block is completed.

    A second Ctrl-C is handled immediately, because a step may hang. Only the main thread receives
    the signal, so this function has no effect in other threads.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGINT)
    if not callable(before):  # Ctrl-C is ignored, or handled outside of Python.
        yield
        return
    pressed: list[FrameType | None] = []

    def note(number: int, frame: FrameType | None) -> None:
        if pressed:
            pressed.clear()
            before(number, frame)
        else:
            pressed.append(frame)

    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if pressed:
            before(signal.SIGINT, pressed[0])
