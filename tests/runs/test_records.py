"""loops.json: what a run compared and closed, and that nothing else changes by it."""

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
from ldo_service.evaluation.results import judge_loops
from ldo_service.runs.finished import read_run
from ldo_service.runs.offline import run_offline
from ldo_service.runs.records import LoopRecord, read_loops
from ldo_service.runs.simulation import ActorDigest, simulate_graph
from ldo_service.runs.source import Selection
from tests.schemas.examples import EXAMPLES

from .jobs import AND_BACK, LONG_AGO, ROUGH, Rearranged, job


@pytest.fixture(scope="module")
def returning(room: Sequence) -> Rearranged:
    return Rearranged(room, AND_BACK)


@pytest.fixture(scope="module")
def finished(returning: Rearranged, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short walk, whose first frames count as long ago."""
    folder = tmp_path_factory.mktemp("loops") / "out"
    run_offline(job(returning, folder, LONG_AGO), print)
    return folder


def test_what_the_loop_closer_says_is_read_back(tmp_path: Path) -> None:
    record, closure, refused = LoopRecord(), EXAMPLES["loop_closure"], EXAMPLES["loop_candidate"]
    record.observe(closure, 60.0)
    record.observe(refused, 60.0)
    record.save(tmp_path)
    found = read_loops(tmp_path)
    assert found is not None
    (compared,), (closed,) = found.candidates, found.closures
    assert (compared.newer, compared.older) == (refused.keyframes, refused.reference_keyframes)
    assert compared.is_closure == (not refused.rejected_reason)
    assert compared.ms == 60.0
    assert (closed.keyframe, closed.reference) == (closure.pose.keyframe, closure.pose.reference)
    np.testing.assert_allclose(
        closed.T_reference_keyframe[:3, 3], closure.pose.T_reference_keyframe.translation
    )
    assert (record.accepted, record.rejected) == (1, bool(refused.rejected_reason))


def test_a_closure_that_the_graph_does_not_believe_is_no_accepted_one(tmp_path: Path) -> None:
    record, closure = LoopRecord(), EXAMPLES["loop_closure"]
    record.observe(closure, 60.0)
    pair = closure.pose.reference, closure.pose.keyframe
    others = ((900, 901),)  # a correction has room for the newest alone
    for not_believed, closures, accepted in (
        *(((pair,), (), 0), (others, (), 0)),
        *(((), (pair,), 1), ((), (), 1)),
        ((pair,), (), 0),
    ):
        correction = msgspec.structs.replace(
            EXAMPLES["graph_correction"], rejected_closures=not_believed, accepted_closures=closures
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


def test_its_loops_are_judged_by_the_truth(finished: Path, returning: Rearranged) -> None:
    truth = returning.truth()
    errors = judge_loops(read_run(finished), returning, truth)
    assert errors is not None
    assert max(errors.position_errors_m) < 0.01


def test_a_file_of_something_else_is_refused(tmp_path: Path) -> None:
    assert read_loops(tmp_path) is None
    for text in ("[]", '{"candidates": [{}], "closures": []}', "no JSON"):
        (tmp_path / "loops.json").write_text(text)
        with pytest.raises(DataError, match=r"loops\.json"):
            read_loops(tmp_path)


def test_a_run_that_meets_nothing_again_is_what_it_is_without_a_loop_closer(
    room: Sequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    def simulated() -> dict[str, ActorDigest]:
        config, first = load_config(settings=(ROUGH,)), Selection(max_frames=20)
        return simulate_graph(room, config, first, print, lambda _done: None)

    whole = simulated()
    assert whole.pop("loop_closer").messages == 0
    others = [box for box in GRAPH if box.name != "loop_closer"]
    monkeypatch.setattr(topology, "GRAPH", tuple(others))
    assert simulated() == whole
