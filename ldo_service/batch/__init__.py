"""Batch of recordings: each one run, evaluated and exported in its own process, here or on Ray.

`find_recordings` finds the sources, `process` does all work of one recording, and an executor
(`LocalExecutor`, `RayExecutor`) runs `process` for each of them. `ldo batch` and `ldo suite` use
the same executors.
"""

from .executors import Executor, LocalExecutor
from .job import BatchJob, Outcome
from .ray_executor import RayExecutor, RayNeeds
from .results import ResultFolder
from .sources import Recording, find_recordings
from .store import Store, open_store
from .work import process

__all__ = [
    "BatchJob",
    "Executor",
    "LocalExecutor",
    "Outcome",
    "RayExecutor",
    "RayNeeds",
    "Recording",
    "ResultFolder",
    "Store",
    "find_recordings",
    "open_store",
    "process",
]
