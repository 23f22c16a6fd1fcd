"""False closures are refused or leave; true ones undo the drift."""

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

FALSE_AT = (60, 95, 130, 165)


@pytest.mark.parametrize("seed", range(2))
def test_four_planted_false_closures_change_nothing(seed: int) -> None:
    truth = kitchen()
    measured = list(odometry(truth, seed, window=3, drift_share=0.005, drift_rad_per_m=0.004))
    true = closures(truth, 12, 40, seed)
    false = false_closures(truth, FALSE_AT, 30, seed)
    chain, without, planted = (
        walked(truth[0], measured, *loops) for loops in ((), (true,), (false, true))
    )
    assert len(false) == 4
    assert not {(c.a, c.b) for c in false.values()} & planted.closures.accepted.keys()
    assert len(planted.closures.accepted) == len(true) == 8
    assert ate_m(planted, truth) < 1.1 * ate_m(without, truth)
    assert ate_m(without, truth) < 0.5 * ate_m(chain, truth)


@pytest.mark.parametrize("seed", [0, *(pytest.param(s, marks=pytest.mark.slow) for s in (1, 2))])
def test_true_closures_undo_the_drift(seed: int) -> None:
    """1 % of the way and 0.5 deg/m, twice around."""
    truth = round_trips(380, 180)
    drift = {"drift_share": 0.01, "drift_rad_per_m": np.radians(0.5)}
    measured = list(odometry(truth, seed, window=3, **drift))
    loops = closures(truth, 8, 90, seed)
    closed = walked(truth[0], measured, loops)
    assert len(closed.closures.accepted) == len(loops) > 20
    assert ate_m(closed, truth) < 0.2 * ate_m(walked(truth[0], measured), truth)


def test_a_refused_closure_leaves_the_same_bits() -> None:
    truth = kitchen(100)
    graph = walked(truth[0], odometry(truth, 1, window=3))
    before = graph.all_poses()[1]
    ((_, false),) = false_closures(truth, [99], 30, 1).items()
    verdict = graph.add_loop_closure(false)
    assert not verdict.changes
    assert graph.closures.rejected == ((false.a, false.b),)
    np.testing.assert_array_equal(graph.all_poses()[1], before)


def off_by(truth: list[np.ndarray], a: int, b: int, *xi: float) -> RelativePose:
    T = se3.inverse(truth[a]) @ truth[b] @ se3.exp(np.array(xi or [0.0] * 6))
    return RelativePose(a, b, T, REFINED)


def test_a_false_closure_that_seemed_possible_leaves_when_true_ones_refute_it() -> None:
    truth = round_trips(120, 100)
    graph = walked(truth[0], odometry(truth, 2, window=3))
    seemed = off_by(truth, 3, 103, 0, 0.1, 0, 0.25, 0, 0)
    assert graph.add_loop_closure(seemed).is_accepted, "the chain is long enough to bend so far"
    bent_m = ate_m(graph, truth)
    verdict = graph.add_loop_closure(off_by(truth, 8, 108))
    assert verdict.is_accepted
    assert verdict.dropped == graph.closures.removed == ((3, 103),)
    assert ate_m(graph, truth) < 0.3 * bent_m


def test_a_pair_that_is_judged_again_is_told_once() -> None:
    truth = round_trips(120, 100)
    graph = walked(truth[0], odometry(truth, 2, window=3))
    true, false = off_by(truth, 8, 108), off_by(truth, 8, 108, 0, 0, 0, 3.0, 0, 0)
    assert not graph.add_loop_closure(false).is_accepted
    assert graph.closures.rejected == ((8, 108),)
    assert graph.add_loop_closure(true).is_accepted
    assert graph.closures.rejected == ()
    assert not graph.add_loop_closure(false).is_accepted
    assert graph.closures.rejected == ()
    assert [*graph.closures.accepted] == [(8, 108)]


def test_an_accepted_closure_stays_when_its_pair_is_measured_worse() -> None:
    truth = round_trips(120, 100)
    graph = walked(truth[0], odometry(truth, 2, window=3))
    assert graph.add_loop_closure(off_by(truth, 8, 108)).is_accepted
    for shift_m in np.arange(0.05, 1.0, 0.05):
        verdict = graph.add_loop_closure(off_by(truth, 8, 108, 0, 0, 0, shift_m, 0, 0))
        assert verdict.dropped == ()
        assert [*graph.closures.accepted] == [(8, 108)]
    assert graph.closures.removed == ()


def test_a_pair_that_left_and_is_refused_is_told_once() -> None:
    pair, other = (RelativePose(3, b, np.eye(4), REFINED) for b in (50, 60))
    closures = (
        LoopClosureSet()
        .with_decision(pair, ClosureDecision(True))
        .with_decision(other, ClosureDecision(True, ((3, 50),)))
    )
    assert (closures.removed, closures.rejected) == (((3, 50),), ())
    closures = closures.with_decision(pair, ClosureDecision(False))
    assert (closures.removed, closures.rejected) == ((), ((3, 50),))


def test_a_second_join_of_two_components_is_judged() -> None:
    truth = kitchen(40)
    graph = walked(truth[0], odometry(truth[:20], 1, window=3))
    graph.add_first(20, np.eye(4))
    for b in range(21, 40):
        graph.add(RelativePose(b - 1, b, se3.inverse(truth[b - 1]) @ truth[b], REFINED))
    assert graph.add_loop_closure(off_by(truth, 18, 21)).is_accepted
    before = graph.all_poses()[1]
    assert not graph.add_loop_closure(off_by(truth, 17, 22, 0, 0, 0, 2.0, 0, 0)).is_accepted
    np.testing.assert_array_equal(graph.all_poses()[1], before)
    assert graph.add_loop_closure(off_by(truth, 17, 22)).is_accepted


def test_a_closure_between_components_joins_them() -> None:
    truth = kitchen(20)
    graph = PoseGraph()
    for first in (0, 10):
        graph.add_first(first, truth[first] if first == 0 else np.eye(4))
        for b in range(first + 1, first + 10):
            graph.add(RelativePose(b - 1, b, se3.inverse(truth[b - 1]) @ truth[b], REFINED))
    assert graph.add_loop_closure(off_by(truth, 2, 17)).is_accepted
    for keyframe, T in graph.poses().items():
        np.testing.assert_allclose(T, truth[keyframe], atol=1e-5)


def test_the_older_of_two_closures_that_say_the_same_makes_room() -> None:
    known = LoopClosureSet(LoopClosureConfig(most=3))
    for a, b in ((10, 200), (12, 202), (90, 300), (10, 301)):
        known = known.with_decision(RelativePose(a, b, np.eye(4), np.eye(6)), ClosureDecision(True))
    assert list(known.accepted) == [(12, 202), (90, 300), (10, 301)]
    assert known.rejected == known.removed == ()


# --- joins ----------------------------------------------------------------------------------------
TWO = round_trips(60, 60)
FALSE_JOIN = (3, 38, 0, 0.3, 0, 1.0, 0, 0.5)  # a, b, and by how much it is off: rad, m
TRUE_ONES = [(10, 45), (15, 40), (20, 50), (5, 55)]


def apart(truth: list[np.ndarray], first: int = 30) -> PoseGraph:
    """Two components, the second somewhere else; nothing drifts."""
    graph = PoseGraph()
    for begin, end in ((0, first), (first, len(truth))):
        graph.add_first(begin, truth[begin] if begin == 0 else se3.exp(np.full(6, 0.3)))
        for b in range(begin + 1, end):
            graph.add(RelativePose(b - 1, b, se3.inverse(truth[b - 1]) @ truth[b], REFINED))
    return graph


def test_a_join_stands_against_one_word_and_falls_to_two_that_agree() -> None:
    graph = apart(TWO)
    assert graph.add_loop_closure(off_by(TWO, *FALSE_JOIN)).is_accepted, "nothing to judge it by"
    assert not graph.add_loop_closure(off_by(TWO, *TRUE_ONES[0])).is_accepted
    assert ate_m(graph, TWO) > 0.3
    verdict = graph.add_loop_closure(off_by(TWO, *TRUE_ONES[1]))
    assert verdict == ClosureDecision(True, (FALSE_JOIN[:2],))
    assert graph.closures.removed == (FALSE_JOIN[:2],)
    assert graph.closures.rejected == ()
    assert ate_m(graph, TWO) < 1e-3
    for pair in TRUE_ONES[2:]:
        assert graph.add_loop_closure(off_by(TWO, *pair)).is_accepted


def test_a_join_that_is_recognized_again_does_not_vote_for_itself() -> None:
    graph = apart(TWO)
    graph.add_loop_closure(off_by(TWO, *FALSE_JOIN))
    before = graph.all_poses()[1]
    assert graph.add_loop_closure(off_by(TWO, *FALSE_JOIN)).is_accepted
    assert not graph.closures.accepted
    np.testing.assert_array_equal(graph.all_poses()[1], before)
    assert not graph.add_loop_closure(off_by(TWO, *TRUE_ONES[0])).is_accepted
    assert graph.add_loop_closure(off_by(TWO, *TRUE_ONES[1])) == ClosureDecision(
        True, (FALSE_JOIN[:2],)
    )


def test_false_closures_that_disagree_do_not_outvote_a_join() -> None:
    graph = apart(TWO)
    assert graph.add_loop_closure(off_by(TWO, *TRUE_ONES[0])).is_accepted
    before = graph.all_poses()[1]
    for number, pair in enumerate(TRUE_ONES[1:]):
        assert not graph.add_loop_closure(
            off_by(TWO, *pair, 0, 0.5 * number, 0, 1.0, number, 0)
        ).is_accepted
    np.testing.assert_array_equal(graph.all_poses()[1], before)


def test_a_join_that_closures_agree_with_falls_to_none_but_more() -> None:
    graph = apart(TWO)
    off = FALSE_JOIN[2:]
    for pair in TRUE_ONES[:2]:
        assert graph.add_loop_closure(off_by(TWO, *pair)).is_accepted
    twins = [(4, 56), (12, 52), (18, 47)]  # agree with each other, as in a room furnished alike
    T_wrong = se3.exp(np.array(off))
    for a, b in twins[:2]:
        T = se3.inverse(TWO[a]) @ T_wrong @ TWO[b]
        assert not graph.add_loop_closure(RelativePose(a, b, T, REFINED)).is_accepted
    assert ate_m(graph, TWO) < 1e-3


def test_a_successor_knows_what_contradicted_a_join() -> None:
    graph, successor = apart(TWO), PoseGraph()
    graph.add_loop_closure(off_by(TWO, *FALSE_JOIN))
    graph.add_loop_closure(off_by(TWO, *TRUE_ONES[0]))
    successor.restore(graph.snapshot())
    for one in (graph, successor):
        assert one.add_loop_closure(off_by(TWO, *TRUE_ONES[1])).dropped == (FALSE_JOIN[:2],)
    np.testing.assert_array_equal(graph.all_poses()[1], successor.all_poses()[1])


def in_three(truth: list[np.ndarray]) -> PoseGraph:
    graph = apart(truth[:60])
    graph.add_first(60, se3.exp(np.full(6, -0.2)))
    for b in range(61, 90):
        graph.add(RelativePose(b - 1, b, se3.inverse(truth[b - 1]) @ truth[b], REFINED))
    return graph


def test_of_two_joins_in_a_row_the_contradicted_one_falls() -> None:
    """A third component hangs on the second, and goes where that goes."""
    truth = round_trips(90, 60)
    graph = in_three(truth)
    graph.add_loop_closure(off_by(truth, *FALSE_JOIN))
    assert graph.add_loop_closure(off_by(truth, 40, 70)).is_accepted
    assert not graph.add_loop_closure(off_by(truth, *TRUE_ONES[0])).is_accepted
    assert graph.add_loop_closure(off_by(truth, 12, 72)).dropped == (FALSE_JOIN[:2],)
    assert ate_m(graph, truth) < 1e-3


def test_of_two_joins_in_a_row_the_one_that_others_agree_with_stays() -> None:
    truth = round_trips(90, 60)
    graph = in_three(truth)
    for pair in TRUE_ONES[:2]:
        assert graph.add_loop_closure(off_by(truth, *pair)).is_accepted
    false_join = (40, 70, *FALSE_JOIN[2:])
    assert graph.add_loop_closure(off_by(truth, *false_join)).is_accepted, "nothing to judge it by"
    assert not graph.add_loop_closure(off_by(truth, 5, 65)).is_accepted
    assert graph.add_loop_closure(off_by(truth, 12, 72)).dropped == (false_join[:2],)
    assert set(graph.closures.accepted) >= {TRUE_ONES[1]}
    assert ate_m(graph, truth) < 1e-3


def test_where_either_of_two_joins_may_be_wrong_both_stay() -> None:
    truth = round_trips(90, 60)
    graph = in_three(truth)
    graph.add_loop_closure(off_by(truth, *TRUE_ONES[0]))
    graph.add_loop_closure(off_by(truth, 40, 70, *FALSE_JOIN[2:]))
    for pair in ((5, 65), (12, 72), (20, 80)):
        assert not graph.add_loop_closure(off_by(truth, *pair)).is_accepted
    between = graph.add_loop_closure(off_by(truth, *TRUE_ONES[1]))  # the first join was right
    assert between.is_accepted
    assert graph.add_loop_closure(off_by(truth, 8, 68)).dropped == ((40, 70),)
    assert ate_m(graph, truth) < 1e-3
