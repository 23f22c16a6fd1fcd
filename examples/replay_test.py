"""A recording as a regression test: every actor must still make what it made on the robot.

Record once, with a camera or `ldo publish`, and stop with Ctrl-C:

    ldo record recordings/desk

    LDO_RECORDING=recordings/desk pytest replay_test.py

in a folder of your own; in a clone of this repository after `make test`, which installs what its
settings of pytest ask for.

Each recorded actor is a case. One that fails names the step, and the message that differs.
"""

import os

from ldo_service.testing import RecordedActor, recorded

actor = recorded(os.environ.get("LDO_RECORDING", "recordings/desk"))


def test_the_recording_replays(actor: RecordedActor) -> None:
    assert actor.verify().steps > 0
