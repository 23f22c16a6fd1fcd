"""Tests with some minutes of faults on a real service.

The program `python -m tests.faults.fault_injection` injects hundreds of them.
"""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from ldo_service.conversions.poses import correction_to_message
from ldo_service.schemas import Message
from ldo_service.schemas import encode as encode_message
from ldo_service.transport.flow_control import Credit, Header, encode_link
from tests.faults.camera import frames
from tests.faults.fault_injection import Batch, Outcome, table, whole_batches
from tests.faults.message_recorder import CONSUMERS, CREDITS, MessageRecorder
from tests.schemas.examples import EXAMPLES


@pytest.fixture(scope="module")
def scene() -> list:
    return frames()


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("batch", [0, 1], ids=["actors apart", "one process"])
def test_service_recovers_from_faults_without_lost_or_doubled_data(
    tmp_path: Path, scene: list, batch: int
) -> None:
    outcomes: list[Outcome] = []
    Batch(batch, 7, tmp_path, scene).run(faults=10, report=outcomes.append)
    assert len(outcomes) == 10
    assert [outcome for outcome in outcomes if outcome.violations] == []
    assert sum(outcome.maps for outcome in outcomes) > 0
    assert any(outcome.off_m is not None for outcome in outcomes)


# --- detection of violations ----------------------------------------------------------------------
KEYFRAME = EXAMPLES["keyframe"]
KEYFRAMES = [msgspec.structs.replace(KEYFRAME, keyframe=k, reference=None) for k in range(3)]


def deliver(
    recorder: MessageRecorder, topic: str, message: Message | Credit, seq: int = 0, epoch: int = 1
) -> None:
    body = encode_link(message) if isinstance(message, Credit) else encode_message(message)
    recorder._received.append((topic, encode_link(Header("producer", epoch, seq, 0)), body))
    recorder.update()


def test_recorder_detects_two_keyframes_with_one_id() -> None:
    recorder = MessageRecorder()
    deliver(recorder, "keyframe/new", KEYFRAMES[0])
    deliver(recorder, "link/again/keyframe/new", KEYFRAMES[0])
    assert recorder.violations == [], "an identical message is a retransmission"
    other = msgspec.structs.replace(KEYFRAMES[0], stamp_ns=99)
    deliver(recorder, "keyframe/new", other, seq=1)
    assert recorder.violations == ["keyframe 0 was made twice"]


def test_recorder_tracks_handled_keyframes_of_every_consumer() -> None:
    recorder = MessageRecorder()
    for seq, keyframe in enumerate(KEYFRAMES[:3]):
        deliver(recorder, "keyframe/new", keyframe, seq)
    for consumer in CONSUMERS:
        assert not recorder.is_caught_up()
        deliver(recorder, CREDITS, Credit(consumer, 1, handled=3, arrived=3, limit=11))
    assert recorder.is_caught_up()
    deliver(recorder, CREDITS, Credit("mapper", 1, handled=1, arrived=1, limit=9))
    assert recorder.violations == ["mapper had handled 3 keyframes, and then 1"]


def test_recorder_detects_decreasing_versions_and_lost_keyframes() -> None:
    recorder = MessageRecorder()
    poses = [(k, np.eye(4)) for k in range(2)]
    first, second = (correction_to_message(0, n, dict(poses[:n])) for n in (1, 2))
    deliver(recorder, "graph/correction", second)
    assert recorder.violations == []
    deliver(recorder, "graph/correction", first)
    went_back, lost = recorder.violations
    assert went_back.startswith("version 1 of the graph came after 2")
    assert lost.startswith("the graph lost keyframes")


def test_interrupted_campaign_keeps_its_complete_batches(tmp_path: Path) -> None:
    out = tmp_path / "out.jsonl"
    lines = ['{"batch": 0}'] * 3 + ['{"batch": 1}'] * 2
    out.write_text("\n".join(lines) + "\n")
    assert whole_batches(out, 3) == {0}
    assert out.read_text().splitlines() == lines[:3]
    assert whole_batches(tmp_path / "new.jsonl", 3) == set()


def test_table_has_a_row_for_each_kind() -> None:
    outcomes = [
        Outcome(0, 0, "kill", pose_s=1.0, recovered_s=2.0, maps=3, off_m=0.01),
        Outcome(0, 1, "disk", pose_s=3.0, recovered_s=4.0, maps=2, violations=["broken"]),
    ]
    kill, whole, _, summary = table(outcomes).splitlines()[3:]
    assert kill == "| kill | 1 | 1.0 / 1.0 | 2.0 / 2.0 | 0 |"
    assert whole.startswith("| all | 2 |")
    assert whole.endswith("| 1 |")
    assert summary.startswith("compared to the bit: 5 maps, objects and graph after 0 restarts;")
    assert summary.endswith("1 poses at most 1.0 cm off; restart budget used up 0 times")
