"""Loop candidates and closures of a run in `loops.json`."""

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

from ldo_service.actors import topology
from ldo_service.actors.topology import GRAPH
from ldo_service.config import load_config
from ldo_service.datasets import Sequence
from ldo_service.errors import DataError
from ldo_service.evaluation.results import run_loop_errors
from ldo_service.runs.finished import read_run
from ldo_service.runs.offline import run_offline
from ldo_service.runs.records import LoopRecord, read_loops
from ldo_service.runs.simulation import ActorDigest, simulate_graph
from ldo_service.runs.source import Selection
from tests.schemas.examples import EXAMPLES

from .jobs import OUT_AND_BACK, ROUGH, SHORT_GAP, Rearranged, job


@pytest.fixture(scope="module")
def walk_with_return(room: Sequence) -> Rearranged:
    return Rearranged(room, OUT_AND_BACK)


@pytest.fixture(scope="module")
def finished(walk_with_return: Rearranged, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run over a short walk that may close loops from its end to its start."""
    folder = tmp_path_factory.mktemp("loops") / "out"
    run_offline(job(walk_with_return, folder, SHORT_GAP), print)
    return folder


def test_saved_loops_are_read_back(tmp_path: Path) -> None:
    record, closure, rejected = LoopRecord(), EXAMPLES["loop_closure"], EXAMPLES["loop_candidate"]
    record.observe(closure, 60.0)
    record.observe(rejected, 60.0)
    record.save(tmp_path)
    found = read_loops(tmp_path)
    assert found is not None
    (compared,), (closed,) = found.candidates, found.closures
    assert (compared.newer, compared.older) == (rejected.keyframes, rejected.reference_keyframes)
    assert compared.is_closure == (not rejected.rejected_reason)
    assert compared.ms == 60.0
    assert (closed.keyframe, closed.reference) == (closure.pose.keyframe, closure.pose.reference)
    np.testing.assert_allclose(
        closed.T_reference_keyframe[:3, 3], closure.pose.T_reference_keyframe.translation
    )
    assert (record.accepted, record.rejected) == (1, bool(rejected.rejected_reason))


def test_closure_rejected_by_the_pose_graph_is_not_counted_as_accepted(tmp_path: Path) -> None:
    record, closure = LoopRecord(), EXAMPLES["loop_closure"]
    record.observe(closure, 60.0)
    pair = closure.pose.reference, closure.pose.keyframe
    others = ((900, 901),)  # A correction lists the newest closures only.
    for rejected, closures, accepted in (
        *(((pair,), (), 0), (others, (), 0)),
        *(((), (pair,), 1), ((), (), 1)),
        ((pair,), (), 0),
    ):
        correction = msgspec.structs.replace(
            EXAMPLES["graph_correction"], rejected_closures=rejected, accepted_closures=closures
        )
        record.observe(correction, 1.0)
        assert (record.accepted, record.rejected) == (accepted, 1 - accepted)
    record.save(tmp_path)
    (written,) = json.loads((tmp_path / "loops.json").read_text())["closures"]
    assert written["is_believed"] is False


def test_a_run_writes_its_loops_and_counts_them(finished: Path) -> None:
    found, summary = read_loops(finished), json.loads((finished / "summary.json").read_text())
    assert found is not None
    assert found.candidates
    assert summary["loops_accepted"] == len(found.closures) > 0
    assert summary["loops_rejected"] == len(found.candidates) - len(found.closures)
    assert all(candidate.ms for candidate in found.candidates)


def test_loops_of_a_run_are_evaluated_against_ground_truth(
    finished: Path, walk_with_return: Rearranged
) -> None:
    truth = walk_with_return.truth()
    errors = run_loop_errors(read_run(finished), walk_with_return, truth)
    assert errors is not None
    assert max(errors.position_errors_m) < 0.01


def test_invalid_loops_file_is_refused(tmp_path: Path) -> None:
    assert read_loops(tmp_path) is None
    for text in ("[]", '{"candidates": [{}], "closures": []}', "no JSON"):
        (tmp_path / "loops.json").write_text(text)
        with pytest.raises(DataError, match=r"loops\.json"):
            read_loops(tmp_path)


def test_loop_closer_without_closures_changes_no_other_actor(
    room: Sequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    def simulated() -> dict[str, ActorDigest]:
        config, first = load_config(settings=(ROUGH,)), Selection(max_frames=20)
        return simulate_graph(room, config, first, print, lambda _done: None)

    with_loop_closer = simulated()
    assert with_loop_closer.pop("loop_closer").messages == 0
    others = [box for box in GRAPH if box.name != "loop_closer"]
    monkeypatch.setattr(topology, "GRAPH", tuple(others))
    assert simulated() == with_loop_closer
