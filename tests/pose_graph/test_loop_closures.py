"""Tests of accepting, rejecting and removing loop closures."""

import numpy as np
import pytest

from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import RelativePose
from ldo_service.pose_graph.loop_closures import ClosureDecision, LoopClosureConfig, LoopClosureSet
from ldo_service.pose_graph.pose_graph import PoseGraph

from .trajectories import (
    REFINED,
    ate_m,
    closures,
    false_closures,
    kitchen,
    odometry,
    round_trips,
    walked,
)

FALSE_CLOSURE_KEYFRAMES = (60, 95, 130, 165)


@pytest.mark.parametrize("seed", range(2))
def test_false_closures_are_rejected_without_effect_on_the_poses(seed: int) -> None:
    truth = kitchen()
    measured = list(odometry(truth, seed, window=3, drift_ratio=0.005, drift_rad_per_m=0.004))
    true = closures(truth, 12, 40, seed)
    false = false_closures(truth, FALSE_CLOSURE_KEYFRAMES, 30, seed)
    odometry_only, with_true, with_false = (
        walked(truth[0], measured, *loops) for loops in ((), (true,), (false, true))
    )
    assert len(false) == 4
    assert not {(c.a, c.b) for c in false.values()} & with_false.closures.accepted.keys()
    assert len(with_false.closures.accepted) == len(true) == 8
    assert ate_m(with_false, truth) < 1.1 * ate_m(with_true, truth)
    assert ate_m(with_true, truth) < 0.5 * ate_m(odometry_only, truth)


@pytest.mark.parametrize("seed", [0, *(pytest.param(s, marks=pytest.mark.slow) for s in (1, 2))])
def test_true_closures_remove_most_of_the_drift(seed: int) -> None:
    """Two rounds with a drift of 1 % of the path and 0.5 deg/m."""
    truth = round_trips(380, 180)
    drift = {"drift_ratio": 0.01, "drift_rad_per_m": np.radians(0.5)}
    measured = list(odometry(truth, seed, window=3, **drift))
    loops = closures(truth, 8, 90, seed)
    closed = walked(truth[0], measured, loops)
    assert len(closed.closures.accepted) == len(loops) > 20
    assert ate_m(closed, truth) < 0.2 * ate_m(walked(truth[0], measured), truth)


def test_rejected_closure_leaves_poses_bitwise_equal() -> None:
    truth = kitchen(100)
    graph = walked(truth[0], odometry(truth, 1, window=3))
    before = graph.all_poses()[1]
    ((_, false),) = false_closures(truth, [99], 30, 1).items()
    decision = graph.add_loop_closure(false)
    assert not decision.changes
    assert graph.closures.rejected == ((false.a, false.b),)
    np.testing.assert_array_equal(graph.all_poses()[1], before)


def closure_with_error(truth: list[np.ndarray], a: int, b: int, *xi: float) -> RelativePose:
    """Return a closure of two keyframes, their true pose perturbed by the twist xi."""
    T = se3.inverse(truth[a]) @ truth[b] @ se3.exp(np.array(xi or [0.0] * 6))
    return RelativePose(a, b, T, REFINED)


def test_accepted_false_closure_is_removed_when_a_true_one_contradicts_it() -> None:
    truth = round_trips(120, 100)
    graph = walked(truth[0], odometry(truth, 2, window=3))
    plausible = closure_with_error(truth, 3, 103, 0, 0.1, 0, 0.25, 0, 0)
    assert graph.add_loop_closure(plausible).is_accepted, (
        "odometry from 3 to 103 is uncertain enough for this error"
    )
    bent_ate_m = ate_m(graph, truth)
    decision = graph.add_loop_closure(closure_with_error(truth, 8, 108))
    assert decision.is_accepted
    assert decision.dropped == graph.closures.removed == ((3, 103),)
    assert ate_m(graph, truth) < 0.3 * bent_ate_m


def test_pair_that_is_decided_repeatedly_is_listed_once() -> None:
    truth = round_trips(120, 100)
    graph = walked(truth[0], odometry(truth, 2, window=3))
    true, false = (
        closure_with_error(truth, 8, 108),
        closure_with_error(truth, 8, 108, 0, 0, 0, 3.0, 0, 0),
    )
    assert not graph.add_loop_closure(false).is_accepted
    assert graph.closures.rejected == ((8, 108),)
    assert graph.add_loop_closure(true).is_accepted
    assert graph.closures.rejected == ()
    assert not graph.add_loop_closure(false).is_accepted
    assert graph.closures.rejected == ()
    assert [*graph.closures.accepted] == [(8, 108)]


def test_accepted_closure_stays_when_its_pair_is_measured_worse() -> None:
    truth = round_trips(120, 100)
    graph = walked(truth[0], odometry(truth, 2, window=3))
    assert graph.add_loop_closure(closure_with_error(truth, 8, 108)).is_accepted
    for shift_m in np.arange(0.05, 1.0, 0.05):
        decision = graph.add_loop_closure(closure_with_error(truth, 8, 108, 0, 0, 0, shift_m, 0, 0))
        assert decision.dropped == ()
        assert [*graph.closures.accepted] == [(8, 108)]
    assert graph.closures.removed == ()


def test_removed_pair_that_is_then_rejected_is_listed_once() -> None:
    pair, other = (RelativePose(3, b, np.eye(4), REFINED) for b in (50, 60))
    closures = (
        LoopClosureSet()
        .with_decision(pair, ClosureDecision(True))
        .with_decision(other, ClosureDecision(True, ((3, 50),)))
    )
    assert (closures.removed, closures.rejected) == (((3, 50),), ())
    closures = closures.with_decision(pair, ClosureDecision(False))
    assert (closures.removed, closures.rejected) == ((), ((3, 50),))


def test_second_closure_between_merged_components_is_checked() -> None:
    truth = kitchen(40)
    graph = walked(truth[0], odometry(truth[:20], 1, window=3))
    graph.add_first(20, np.eye(4))
    for b in range(21, 40):
        graph.add(RelativePose(b - 1, b, se3.inverse(truth[b - 1]) @ truth[b], REFINED))
    assert graph.add_loop_closure(closure_with_error(truth, 18, 21)).is_accepted
    before = graph.all_poses()[1]
    assert not graph.add_loop_closure(
        closure_with_error(truth, 17, 22, 0, 0, 0, 2.0, 0, 0)
    ).is_accepted
    np.testing.assert_array_equal(graph.all_poses()[1], before)
    assert graph.add_loop_closure(closure_with_error(truth, 17, 22)).is_accepted


def test_closure_between_components_merges_them() -> None:
    truth = kitchen(20)
    graph = PoseGraph()
    for first in (0, 10):
        graph.add_first(first, truth[first] if first == 0 else np.eye(4))
        for b in range(first + 1, first + 10):
            graph.add(RelativePose(b - 1, b, se3.inverse(truth[b - 1]) @ truth[b], REFINED))
    assert graph.add_loop_closure(closure_with_error(truth, 2, 17)).is_accepted
    for keyframe, T in graph.poses().items():
        np.testing.assert_allclose(T, truth[keyframe], atol=1e-5)


def test_full_closure_set_drops_the_older_of_two_redundant_closures() -> None:
    known = LoopClosureSet(LoopClosureConfig(max_closures=3))
    for a, b in ((10, 200), (12, 202), (90, 300), (10, 301)):
        known = known.with_decision(RelativePose(a, b, np.eye(4), np.eye(6)), ClosureDecision(True))
    assert list(known.accepted) == [(12, 202), (90, 300), (10, 301)]
    assert known.rejected == known.removed == ()


# --- merges of components -------------------------------------------------------------------------
CIRCLE = round_trips(60, 60)
FALSE_MERGE = (3, 38, 0, 0.3, 0, 1.0, 0, 0.5)  # Keyframes a and b; error in rad and m.
TRUE_PAIRS = [(10, 45), (15, 40), (20, 50), (5, 55)]


def two_components(truth: list[np.ndarray], first: int = 30) -> PoseGraph:
    """Return two components without drift, the second in another frame."""
    graph = PoseGraph()
    for begin, end in ((0, first), (first, len(truth))):
        graph.add_first(begin, truth[begin] if begin == 0 else se3.exp(np.full(6, 0.3)))
        for b in range(begin + 1, end):
            graph.add(RelativePose(b - 1, b, se3.inverse(truth[b - 1]) @ truth[b], REFINED))
    return graph


def test_false_merge_survives_one_contradiction_and_falls_to_two_that_agree() -> None:
    graph = two_components(CIRCLE)
    assert graph.add_loop_closure(closure_with_error(CIRCLE, *FALSE_MERGE)).is_accepted, (
        "no closure contradicts it yet"
    )
    assert not graph.add_loop_closure(closure_with_error(CIRCLE, *TRUE_PAIRS[0])).is_accepted
    assert ate_m(graph, CIRCLE) > 0.3
    decision = graph.add_loop_closure(closure_with_error(CIRCLE, *TRUE_PAIRS[1]))
    assert decision == ClosureDecision(True, (FALSE_MERGE[:2],))
    assert graph.closures.removed == (FALSE_MERGE[:2],)
    assert graph.closures.rejected == ()
    assert ate_m(graph, CIRCLE) < 1e-3
    for pair in TRUE_PAIRS[2:]:
        assert graph.add_loop_closure(closure_with_error(CIRCLE, *pair)).is_accepted


def test_repeated_merge_closure_does_not_confirm_itself() -> None:
    graph = two_components(CIRCLE)
    graph.add_loop_closure(closure_with_error(CIRCLE, *FALSE_MERGE))
    before = graph.all_poses()[1]
    assert graph.add_loop_closure(closure_with_error(CIRCLE, *FALSE_MERGE)).is_accepted
    assert not graph.closures.accepted
    np.testing.assert_array_equal(graph.all_poses()[1], before)
    assert not graph.add_loop_closure(closure_with_error(CIRCLE, *TRUE_PAIRS[0])).is_accepted
    assert graph.add_loop_closure(closure_with_error(CIRCLE, *TRUE_PAIRS[1])) == ClosureDecision(
        True, (FALSE_MERGE[:2],)
    )


def test_inconsistent_false_closures_do_not_remove_a_merge() -> None:
    graph = two_components(CIRCLE)
    assert graph.add_loop_closure(closure_with_error(CIRCLE, *TRUE_PAIRS[0])).is_accepted
    before = graph.all_poses()[1]
    for number, pair in enumerate(TRUE_PAIRS[1:]):
        assert not graph.add_loop_closure(
            closure_with_error(CIRCLE, *pair, 0, 0.5 * number, 0, 1.0, number, 0)
        ).is_accepted
    np.testing.assert_array_equal(graph.all_poses()[1], before)


def test_confirmed_merge_survives_as_many_contradictions() -> None:
    graph = two_components(CIRCLE)
    xi_wrong = FALSE_MERGE[2:]
    for pair in TRUE_PAIRS[:2]:
        assert graph.add_loop_closure(closure_with_error(CIRCLE, *pair)).is_accepted
    # Consistent with each other, as under perceptual aliasing.
    aliased_pairs = [(4, 56), (12, 52), (18, 47)]
    T_wrong = se3.exp(np.array(xi_wrong))
    for a, b in aliased_pairs[:2]:
        T = se3.inverse(CIRCLE[a]) @ T_wrong @ CIRCLE[b]
        assert not graph.add_loop_closure(RelativePose(a, b, T, REFINED)).is_accepted
    assert ate_m(graph, CIRCLE) < 1e-3


def test_restored_graph_keeps_the_contradictions_of_a_merge() -> None:
    graph, restored = two_components(CIRCLE), PoseGraph()
    graph.add_loop_closure(closure_with_error(CIRCLE, *FALSE_MERGE))
    graph.add_loop_closure(closure_with_error(CIRCLE, *TRUE_PAIRS[0]))
    restored.restore(graph.snapshot())
    for each in (graph, restored):
        assert each.add_loop_closure(closure_with_error(CIRCLE, *TRUE_PAIRS[1])).dropped == (
            FALSE_MERGE[:2],
        )
    np.testing.assert_array_equal(graph.all_poses()[1], restored.all_poses()[1])


def three_components(truth: list[np.ndarray]) -> PoseGraph:
    """Return three components without drift, each in a frame of its own."""
    graph = two_components(truth[:60])
    graph.add_first(60, se3.exp(np.full(6, -0.2)))
    for b in range(61, 90):
        graph.add(RelativePose(b - 1, b, se3.inverse(truth[b - 1]) @ truth[b], REFINED))
    return graph


def test_contradicted_merge_is_removed_from_a_chain_of_two() -> None:
    """The third component is merged to the second and moves with it."""
    truth = round_trips(90, 60)
    graph = three_components(truth)
    graph.add_loop_closure(closure_with_error(truth, *FALSE_MERGE))
    assert graph.add_loop_closure(closure_with_error(truth, 40, 70)).is_accepted
    assert not graph.add_loop_closure(closure_with_error(truth, *TRUE_PAIRS[0])).is_accepted
    assert graph.add_loop_closure(closure_with_error(truth, 12, 72)).dropped == (FALSE_MERGE[:2],)
    assert ate_m(graph, truth) < 1e-3


def test_confirmed_merge_stays_in_a_chain_of_two() -> None:
    truth = round_trips(90, 60)
    graph = three_components(truth)
    for pair in TRUE_PAIRS[:2]:
        assert graph.add_loop_closure(closure_with_error(truth, *pair)).is_accepted
    false_merge = (40, 70, *FALSE_MERGE[2:])
    assert graph.add_loop_closure(closure_with_error(truth, *false_merge)).is_accepted, (
        "no closure contradicts it yet"
    )
    assert not graph.add_loop_closure(closure_with_error(truth, 5, 65)).is_accepted
    assert graph.add_loop_closure(closure_with_error(truth, 12, 72)).dropped == (false_merge[:2],)
    assert set(graph.closures.accepted) >= {TRUE_PAIRS[1]}
    assert ate_m(graph, truth) < 1e-3


def test_both_merges_of_a_chain_stay_while_the_wrong_one_is_ambiguous() -> None:
    truth = round_trips(90, 60)
    graph = three_components(truth)
    graph.add_loop_closure(closure_with_error(truth, *TRUE_PAIRS[0]))
    graph.add_loop_closure(closure_with_error(truth, 40, 70, *FALSE_MERGE[2:]))
    for pair in ((5, 65), (12, 72), (20, 80)):
        assert not graph.add_loop_closure(closure_with_error(truth, *pair)).is_accepted
    # Confirms the first merge.
    confirmation = graph.add_loop_closure(closure_with_error(truth, *TRUE_PAIRS[1]))
    assert confirmation.is_accepted
    assert graph.add_loop_closure(closure_with_error(truth, 8, 68)).dropped == ((40, 70),)
    assert ate_m(graph, truth) < 1e-3
