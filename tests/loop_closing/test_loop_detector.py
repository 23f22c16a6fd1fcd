"""Tests of the choice among the verified candidates of a subgraph."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import KeyframePoses, RelativePose
from ldo_service.loop_closing import LoopCandidateResult, LoopDetector, LoopsConfig
from ldo_service.loop_closing.place_database import RetrievalMatch
from ldo_service.loop_closing.verification import (
    LoopHypothesis,
    VerificationConfig,
    VerificationResult,
)

NEW = 2  # Id of the keyframe of the new subgraph; the old subgraphs have the keyframes 0 and 1.
DEPTH_ERROR = "the surfaces differ"


def subgraph(keyframe: int) -> Any:
    place = SimpleNamespace(submap=0, median_depth_m=2.0, T_odom_keyframe=np.eye(4))
    view = SimpleNamespace(
        keyframe=keyframe, frame=500 * keyframe, place=place, path_m=50.0 * (keyframe == NEW)
    )
    return SimpleNamespace(submap=0, views=(view,))


def results(
    monkeypatch: pytest.MonkeyPatch,
    inliers: tuple[int, int],
    reasons: tuple[str, str],
    is_second_near: bool = False,
) -> list[LoopCandidateResult]:
    """Return the results of two candidates, 4 m apart.

    Args:
        monkeypatch: Fixture, which replaces retrieval and verification.
        inliers: Inliers of both candidates.
        reasons: Reasons for which the verification rejects them; "" if it accepts them.
        is_second_near: True if the map makes the second one a candidate, not its similarity.
    """
    detector, new = LoopDetector(LoopsConfig()), subgraph(NEW)
    matches = [
        RetrievalMatch(subgraph(k), 1.0, 1.0, 1.0, 1.0, is_near=is_near)
        for k, is_near in enumerate((False, is_second_near))
    ]
    poses = KeyframePoses()
    for k, x_m in enumerate((0.0, 4.0, 2.0)):
        poses.add(k, None, np.eye(4), se3.exp(np.array([0, 0, 0, x_m, 0, 0])))

    def proposed(old: Any, new: Any, _known: Any) -> LoopHypothesis:
        view = old.views[0]
        count = inliers[view.keyframe]
        return LoopHypothesis(view, new.views[0], np.eye(4), "features", count)

    def checked(proposal: LoopHypothesis) -> VerificationResult:
        old = proposal.old.keyframe
        closure = RelativePose(old, NEW, np.eye(4), np.eye(6))
        return VerificationResult(
            proposal,
            rejected_reason=reasons[old],
            closure=None if reasons[old] else closure,
        )

    monkeypatch.setattr(detector._memory, "query", lambda *_: matches)
    monkeypatch.setattr(detector, "_proposal", proposed)
    monkeypatch.setattr(detector, "_check", checked)
    return detector._findings(new, poses, {}, None)


def reasons_of(found: list[LoopCandidateResult]) -> list[str]:
    return [one.check.rejected_reason for one in found]


def test_two_candidates_that_pass_at_different_places_are_ambiguous(monkeypatch) -> None:
    found = results(monkeypatch, (60, 50), ("", ""))
    assert reasons_of(found) == ["ambiguous: another place fits as well"] * 2
    assert not any(one.closure for one in found)


def test_candidate_that_fails_the_verification_makes_no_other_ambiguous(monkeypatch) -> None:
    found = results(monkeypatch, (60, 50), (DEPTH_ERROR, ""))
    assert reasons_of(found) == [DEPTH_ERROR, ""]
    assert found[0].closure is None
    assert found[1].closure is not None


def test_clearly_better_candidate_closes_the_loop(monkeypatch) -> None:
    """The worse candidate has less than half of the better one's inliers: only it is ambiguous."""
    found = results(monkeypatch, (20, 60), ("", ""))
    assert reasons_of(found) == ["ambiguous: another place fits as well", ""]
    assert found[1].closure is not None


@pytest.mark.parametrize(("reason", "expected"), [(DEPTH_ERROR, [DEPTH_ERROR, ""]), ("", [""])])
def test_nearest_subgraph_is_verified_only_if_no_similar_one_passes(
    monkeypatch, reason: str, expected: list[str]
) -> None:
    found = results(monkeypatch, (60, 50), (reason, ""), is_second_near=True)
    assert reasons_of(found) == expected
    assert found[-1].closure is not None


@pytest.mark.parametrize("name", ["blind_overlap", "map_overlap"])
@pytest.mark.parametrize("value", [-0.1, 1.1, np.nan])
def test_overlap_outside_of_0_to_1_is_refused(name: str, value: float) -> None:
    settings: dict[str, Any] = {name: value}
    with pytest.raises(ConfigError, match=name):
        VerificationConfig(**settings)
