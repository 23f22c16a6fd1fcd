"""Fixtures of the tests of batches."""

from collections.abc import Callable
from pathlib import Path

import pytest

from ldo_service.batch.batch import Batch
from ldo_service.batch.job import RunPlan
from ldo_service.batch.store import open_store
from ldo_service.config import load_config

MAX_STAGED_BYTES = 10**9


@pytest.fixture
def batch(tmp_path: Path) -> Callable[..., Batch]:
    """Return a function that makes a batch with results in an address and with given options."""

    def make(
        out: str | Path = tmp_path / "out", max_staged_bytes: int = MAX_STAGED_BYTES, **options
    ):
        config = load_config(settings=("mapper.threads=1", "mapper.iterations=1"))
        plan = RunPlan(config=config, **options)
        return Batch(plan, open_store(str(out)), tmp_path / "staging", max_staged_bytes)

    return make
