"""Test of a live service whose camera's clock is set while it runs."""

from pathlib import Path

import msgspec
import pytest

from ldo_service.conversions.frames import raw_frame_to_message
from ldo_service.datasets import Sequence
from tests.service.conftest import live_service

HOUR_NS = 3600 * 1_000_000_000


@pytest.mark.slow
def test_no_pose_is_missed_when_the_clock_is_set_by_an_hour_or_a_day(
    tmp_path: Path, room: Sequence
) -> None:
    steps_h = (0, 1, 0, -24, 24)  # Difference to the right time, in hours.
    with live_service(tmp_path) as service:
        service.wait_for_actors()
        statuses = []
        for index in range(8 * len(steps_h)):
            frame = raw_frame_to_message(room.read(index))
            stamp_ns = frame.stamp_ns + (48 + steps_h[index // 8]) * HOUR_NS
            frame = msgspec.structs.replace(frame, stamp_ns=stamp_ns)
            statuses.append(service.pose_of(frame).status)
        assert statuses == ["OK"] * len(statuses)
        keyframes = service.update_health()["mapper"].metrics["keyframes"]
        assert keyframes > 1
        assert service.stop() == 0
