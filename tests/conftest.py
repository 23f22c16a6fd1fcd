"""Fixtures that many rooms share."""

import os
from pathlib import Path

import pytest

from ldo_service.datasets import Cached, Sequence, open_sequence


@pytest.fixture(scope="session")
def room() -> Sequence:
    """The synthetic room with its exact truth; frames are ray cast once a session."""
    return Cached(open_sequence("synthetic:room"))


@pytest.fixture(scope="session")
def data() -> Path:
    """The shared data sets."""
    folder = os.environ.get("LDO_DATA")
    if not folder:
        pytest.skip("set LDO_DATA to a folder with tum/kitchen and replica/apartment_floor1")
    return Path(folder)
