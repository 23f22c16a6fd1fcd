"""Frames of a flat into the cache, by several processes."""

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache, partial
from multiprocessing import get_context

from .sequence import FlatConfig, FlatSequence


def prerender(
    config: FlatConfig,
    processes: int,
    frames: range | None = None,
    advance: Callable[[int], None] | None = None,
) -> None:
    """Render those of `frames` (None: all) that are not cached yet: about a second per frame of
    640x480 and process. `advance` is called with the number of frames done."""
    indices = range(len(FlatSequence(config))) if frames is None else frames
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        for done, _ in enumerate(pool.map(partial(_read, config), indices), 1):
            if advance is not None:
                advance(done)


def _read(config: FlatConfig, index: int) -> None:
    _sequence(config).read(index)


@lru_cache(maxsize=1)
def _sequence(config: FlatConfig) -> FlatSequence:
    """Made once in a process: its furniture takes a second."""
    return FlatSequence(config)
