"""Pytest fixtures that replay a recording as a test.

    from ldo_service.testing import recorded

    actor = recorded("recordings/desk")             # A fixture with one case per recorded actor.

    def test_the_recording_replays(actor): actor.verify()

The module needs pytest, which is not installed with this package.
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
    """Replay recorded actors and verify their outputs.

    Args:
        folder: Folder of the recording.
        actors: Names of the actors; all recorded actors by default.

    Returns:
        The report of each replay, by the name of the actor.

    Raises:
        ReplayDiverged: A step differs from the recording.
        DataError: The recording has a gap.
    """
    return {actor.name: actor.verify() for actor in open_recording(Path(folder), actors)}


def recorded(folder: Path | str) -> Callable[..., Any]:
    """Create a fixture with one case per recorded actor.

    Tests with the fixture are skipped if the folder has no recording.
    """
    absent = pytest.param(
        None, marks=pytest.mark.skip(f"no recording in {folder}: create it by `ldo record`")
    )

    @pytest.fixture(params=list(recorded_actors(Path(folder))) or [absent])
    def recorded_actor(request: pytest.FixtureRequest) -> RecordedActor:
        (actor,) = open_recording(Path(folder), (request.param,))
        return actor

    return recorded_actor
