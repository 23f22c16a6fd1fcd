"""Faults on a real service for minutes.

`python -m tests.faults.fault_injection` injects hundreds.
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
from tests.faults.message_recorder import GRANTS, TAKERS, Witness
from tests.schemas.examples import EXAMPLES


@pytest.fixture(scope="module")
def scene() -> list:
    return frames()


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("batch", [0, 1], ids=["actors apart", "one process"])
def test_after_each_fault_nothing_is_lost_or_doubled(
    tmp_path: Path, scene: list, batch: int
) -> None:
    outcomes: list[Outcome] = []
    Batch(batch, 7, tmp_path, scene).run(faults=10, tell=outcomes.append)
    assert len(outcomes) == 10
    assert [outcome for outcome in outcomes if outcome.violations] == []
    assert sum(outcome.maps for outcome in outcomes) > 0
    assert any(outcome.off_m is not None for outcome in outcomes)


# --- the judge ------------------------------------------------------------------------------------
KEYFRAME = EXAMPLES["keyframe"]
KEYFRAMES = [msgspec.structs.replace(KEYFRAME, keyframe=k, reference=None) for k in range(3)]


def hear(
    witness: Witness, topic: str, message: Message | Credit, seq: int = 0, epoch: int = 1
) -> None:
    body = encode_link(message) if isinstance(message, Credit) else encode_message(message)
    witness._heard.append((topic, encode_link(Header("somebody", epoch, seq, 0)), body))
    witness.update()


def test_a_witness_sees_a_keyframe_that_is_made_twice() -> None:
    witness = Witness()
    hear(witness, "keyframe/new", KEYFRAMES[0])
    hear(witness, "link/again/keyframe/new", KEYFRAMES[0])
    assert witness.violations == [], "the same again is a repetition"
    other = msgspec.structs.replace(KEYFRAMES[0], stamp_ns=99)
    hear(witness, "keyframe/new", other, seq=1)
    assert witness.violations == ["keyframe 0 was made twice"]


def test_a_witness_knows_what_everybody_has_handled() -> None:
    witness = Witness()
    for seq, keyframe in enumerate(KEYFRAMES[:3]):
        hear(witness, "keyframe/new", keyframe, seq)
    for taker in TAKERS:
        assert not witness.is_caught_up()
        hear(witness, GRANTS, Credit(taker, 1, handled=3, arrived=3, limit=11))
    assert witness.is_caught_up()
    hear(witness, GRANTS, Credit("mapper", 1, handled=1, arrived=1, limit=9))
    assert witness.violations == ["mapper had handled 3 keyframes, and then 1"]


def test_a_witness_sees_versions_go_back_and_keyframes_vanish() -> None:
    witness = Witness()
    poses = [(k, np.eye(4)) for k in range(2)]
    first, second = (correction_to_message(0, n, dict(poses[:n])) for n in (1, 2))
    hear(witness, "graph/correction", second)
    assert witness.violations == []
    hear(witness, "graph/correction", first)
    went_back, lost = witness.violations
    assert went_back.startswith("version 1 of the graph came after 2")
    assert lost.startswith("the graph lost keyframes")


def test_a_campaign_goes_on_where_it_was_interrupted(tmp_path: Path) -> None:
    out = tmp_path / "out.jsonl"
    lines = ['{"batch": 0}'] * 3 + ['{"batch": 1}'] * 2
    out.write_text("\n".join(lines) + "\n")
    assert whole_batches(out, 3) == {0}
    assert out.read_text().splitlines() == lines[:3]
    assert whole_batches(tmp_path / "new.jsonl", 3) == set()


def test_the_table_has_a_row_for_each_kind() -> None:
    outcomes = [
        Outcome(0, 0, "kill", pose_s=1.0, recovered_s=2.0, maps=3, off_m=0.01),
        Outcome(0, 1, "disk", pose_s=3.0, recovered_s=4.0, maps=2, violations=["broken"]),
    ]
    kill, whole, _, said = table(outcomes).splitlines()[3:]
    assert kill == "| kill | 1 | 1.0 / 1.0 | 2.0 / 2.0 | 0 |"
    assert whole.startswith("| all | 2 |")
    assert whole.endswith("| 1 |")
    assert said.startswith("compared to the bit: 5 maps, objects and graph after 0 restarts;")
    assert said.endswith("1 poses at most 1.0 cm off")
