"""Batch processing of recordings, on this machine or on a Ray cluster.

`find_recordings` finds the recordings. `process` does all work on one recording: SLAM, evaluation
and export. An executor (`LocalExecutor`, `RayExecutor`) calls `process` for each recording in a
process of its own. `ldo batch` and `ldo suite` use the same executors.
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
