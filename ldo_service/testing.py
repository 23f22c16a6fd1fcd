"""A recording as a test, in three lines:

    from ldo_service.testing import recorded

    actor = recorded("recordings/desk")             # a fixture: one case for each recorded actor

    def test_the_recording_replays(actor): actor.verify()

Needs pytest, which is not installed with this package.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ldo_service.recordings.recording import recorded_actors
from ldo_service.recordings.replay import ReplayReport
from ldo_service.runs.replayed import RecordedActor, open_recording

__all__ = ["RecordedActor", "ReplayReport", "recorded", "replay_recording"]


def replay_recording(folder: Path | str, *actors: str) -> dict[str, ReplayReport]:
    """Replay the recorded actors, or some, and count what they did.

    Raises ReplayDiverged at the first difference, DataError for a recording with a gap.
    """
    return {actor.name: actor.verify() for actor in open_recording(Path(folder), actors)}


def recorded(folder: Path | str) -> Callable[..., Any]:
    """A fixture whose cases are the recorded actors; skipped where there is no recording."""
    absent = pytest.param(None, marks=pytest.mark.skip(f"no recording in {folder}: `ldo record`"))

    @pytest.fixture(params=list(recorded_actors(Path(folder))) or [absent])
    def recorded_actor(request: pytest.FixtureRequest) -> RecordedActor:
        (actor,) = open_recording(Path(folder), (request.param,))
        return actor

    return recorded_actor
