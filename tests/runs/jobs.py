"""Runs whose map need not be beautiful."""

from pathlib import Path

from ldo_service.config import load_config
from ldo_service.datasets import Sequence
from ldo_service.runs.folder import prepare
from ldo_service.runs.job import Job
from ldo_service.runs.source import Selection, Warn

ROUGH = "mapper.iterations=1"  # as fast as can be, with every part of the mapper in use


def job(
    sequence: Sequence,
    folder: Path,
    *settings: str,
    frames: int | None = None,
    warn: Warn = print,
) -> Job:
    """Of the first frames, or all, into a new folder."""
    prepare(folder, overwrite=False)
    config = load_config(settings=(ROUGH, *settings))
    return Job(sequence, folder, config, Selection(max_frames=frames), warn)
