"""Regression test that replays a recording: every actor must publish the same messages again.

Record once. `ldo record` runs the service as `ldo serve` does, and records its inputs. Send frames
from a camera or with `ldo publish`, then stop `ldo record` with Ctrl-C:

    ldo record recordings/desk

Run `.venv/bin/pip install pytest`, copy this file to a folder of your own and run:

    LDO_RECORDING=recordings/desk pytest replay_test.py

In a clone of this repository, first run `make test` once. It installs the plugins that the pytest
settings of the clone need.

Each recorded actor is one test case. A failure reports the step and the message that differs.
"""

import os

from ldo_service.testing import RecordedActor, recorded

actor = recorded(os.environ.get("LDO_RECORDING", "recordings/desk"))


def test_the_recording_replays(actor: RecordedActor) -> None:
    assert actor.verify().steps > 0
