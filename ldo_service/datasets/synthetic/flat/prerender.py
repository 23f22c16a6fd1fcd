"""All frames of a flat into the cache, by several processes."""

from collections.abc import Sequence as Indices
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from .sequence import FlatConfig, FlatSequence


def prerender(config: FlatConfig, processes: int) -> None:
    """Render what is not cached yet: about a second per frame of 640x480 and process."""
    shares = [range(start, len(FlatSequence(config)), processes) for start in range(processes)]
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        for _ in pool.map(_read, [config] * processes, shares):
            pass


def _read(config: FlatConfig, indices: Indices[int]) -> None:
    sequence = FlatSequence(config)
    for index in indices:
        sequence.read(index)
