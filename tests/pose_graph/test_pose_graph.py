"""Tests of the incremental pose graph against ground truth and batch solutions."""

import gtsam
import numpy as np
import pytest
import scipy.optimize

from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import RelativePose
from ldo_service.pose_graph.condensation import group_to_condense
from ldo_service.pose_graph.factors import NoiseConfig
from ldo_service.pose_graph.pose_graph import PoseGraph
from ldo_service.pose_graph.pose_graph_config import PoseGraphConfig
from ldo_service.storage.state_codec import decode_state, encode_state

from .trajectories import REFINED, ate_m, closures, kitchen, odometry, round_trips, walked

INFORMATION = np.diag([1e4, 1e4, 1e4, 1e3, 1e3, 1e3])
LOOP = np.diag([400.0] * 6)


def circle(count: int) -> list[np.ndarray]:
    """Return true T_map_keyframe on a circle, looking outwards."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        T = se3.exp(np.array([0, angle, 0, 0, 0, 0]))
        T[:3, 3] = 2 * np.sin(angle), 0.1 * np.sin(3 * angle), 2 * np.cos(angle)
        poses.append(T)
    return poses


def measured(
    truth: list[np.ndarray], pairs: list[tuple[int, int]], sigma: float
) -> list[RelativePose]:
    """Return relative-pose measurements of pairs of keyframes, with noise."""
    rng = np.random.default_rng(5)
    return [
        RelativePose(
            a,
            b,
            se3.inverse(truth[a]) @ truth[b] @ se3.exp(rng.normal(scale=sigma, size=6)),
            INFORMATION,
        )
        for a, b in pairs
    ]


def graph_of(truth: list[np.ndarray], measurements: list[RelativePose]) -> PoseGraph:
    graph = PoseGraph()
    graph.add_first(0, truth[0])
    for measurement in measurements:
        graph.add(measurement)
    return graph


def test_exact_odometry_reproduces_the_ground_truth() -> None:
    truth = circle(20)
    graph = graph_of(truth, measured(truth, [(i, i + 1) for i in range(19)], 0.0))
    for keyframe, T in graph.poses().items():
        np.testing.assert_allclose(T, truth[keyframe], atol=1e-6)


def test_incremental_poses_equal_a_batch_solution() -> None:
    truth = circle(12)
    measurements = measured(truth, [(i, i + 1) for i in range(11)], 0.02)
    graph = graph_of(truth, measurements)
    batch, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    batch.add(
        gtsam.PriorFactorPose3(0, gtsam.Pose3(truth[0]), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6))
    )
    values.insert(0, gtsam.Pose3(truth[0]))
    for m in measurements:
        noise = gtsam.noiseModel.Gaussian.Information(m.information)
        batch.add(gtsam.BetweenFactorPose3(m.a, m.b, gtsam.Pose3(m.T_a_b), noise))
        values.insert(m.b, gtsam.Pose3(truth[m.b]))
    solved = gtsam.LevenbergMarquardtOptimizer(batch, values).optimize()
    for keyframe, T in graph.poses().items():
        np.testing.assert_allclose(T, solved.atPose3(keyframe).matrix(), atol=1e-5)


def test_measurement_without_information_is_accepted() -> None:
    graph = PoseGraph()
    graph.add_first(0, np.eye(4))
    T = se3.exp(np.array([0.1, 0, 0, 0.2, 0, 0]))
    graph.add(RelativePose(0, 1, T, np.zeros((6, 6))))
    np.testing.assert_allclose(graph.pose(1), T, atol=1e-9)


def test_measurement_from_an_unknown_keyframe_raises() -> None:
    graph = PoseGraph()
    graph.add_first(0, np.eye(4))
    with pytest.raises(KeyError):
        graph.add(RelativePose(7, 8, np.eye(4), INFORMATION))


def test_restored_graph_continues_with_the_same_poses() -> None:
    truth = circle(16)
    measurements = measured(truth, [(i, i + 1) for i in range(15)], 0.02)
    uninterrupted = graph_of(truth, measurements)
    first, second = graph_of(truth, measurements[:8]), PoseGraph()
    second.restore(first.snapshot())
    for measurement in measurements[8:]:
        second.add(measurement)
    for keyframe, T in uninterrupted.poses().items():
        np.testing.assert_allclose(second.pose(keyframe), T, atol=1e-6)


def test_equal_measurements_give_bitwise_equal_poses() -> None:
    truth = circle(16)
    measurements = measured(truth, [(i, i + 1) for i in range(15)], 0.02)
    first, second = (graph_of(truth, measurements).poses() for _ in range(2))
    for keyframe in first:
        np.testing.assert_array_equal(first[keyframe], second[keyframe])


def test_small_changes_of_a_measurement_move_all_later_keyframes() -> None:
    truth = circle(16)
    graph = graph_of(truth, measured(truth, [(i, i + 1) for i in range(15)], 0.0))
    T_0_1 = se3.inverse(truth[0]) @ truth[1]
    T = T_0_1
    for step in range(1, 21):
        T = T_0_1 @ se3.exp(np.array([0, 0, 0, step * 5e-4, 0, 0]))
        graph.replace([RelativePose(0, 1, T, INFORMATION)])
    moved = graph.pose(0) @ T @ se3.inverse(truth[1])
    for keyframe in range(1, 16):
        np.testing.assert_allclose(graph.pose(keyframe), moved @ truth[keyframe], atol=1e-6)


def test_replaced_measurement_counts_once_before_and_after_a_restore() -> None:
    truth = circle(8)
    measurements = measured(truth, [(i, i + 1) for i in range(7)], 0.0)
    graph = graph_of(truth, measurements)
    closure = RelativePose(0, 7, se3.inverse(truth[0]) @ truth[7], INFORMATION)
    graph.replace([closure])
    wrong = RelativePose(3, 4, measurements[3].T_a_b @ se3.exp(np.full(6, 0.1)), INFORMATION)
    graph.replace([wrong])
    graph.replace([measurements[3]])
    restored = PoseGraph()
    restored.restore(graph.snapshot())
    for keyframe, T in graph.poses().items():
        # The solver does not relinearize below 0.01.
        np.testing.assert_allclose(T, truth[keyframe], atol=5e-3)
        np.testing.assert_array_equal(restored.pose(keyframe), T)


def test_replacing_a_measurement_of_an_unknown_keyframe_raises() -> None:
    graph = graph_of(circle(4), measured(circle(4), [(0, 1)], 0.0))
    with pytest.raises(KeyError):
        graph.replace([RelativePose(0, 9, np.eye(4), INFORMATION)])


def test_keyframe_can_be_measured_from_several_others() -> None:
    truth = circle(3)
    graph = graph_of(truth, measured(truth, [(0, 1)], 0.0))
    right = measured(truth, [(0, 2)], 0.0)[0]
    T_wrong = se3.inverse(truth[1]) @ truth[2] @ se3.exp(np.array([0, 0, 0, 0.3, 0, 0]))
    graph.add(RelativePose(1, 2, T_wrong, 1e-4 * INFORMATION), right)
    np.testing.assert_allclose(graph.pose(2), truth[2], atol=5e-2)
    restored = PoseGraph()
    restored.restore(graph.snapshot())
    np.testing.assert_allclose(restored.pose(2), graph.pose(2), atol=1e-6)


def test_adding_two_keyframes_at_once_or_from_an_unknown_one_raises() -> None:
    truth = circle(4)
    graph = graph_of(truth, measured(truth, [(0, 1)], 0.0))
    with pytest.raises(ValueError, match="all measurements must have the same b"):
        graph.add(*measured(truth, [(0, 2), (0, 3)], 0.0))
    with pytest.raises(KeyError):
        graph.add(*measured(truth, [(0, 2), (3, 2)], 0.0))
    assert 2 not in graph


# --- components -----------------------------------------------------------------------------------
def two_components(truth: list[np.ndarray], T_apart: np.ndarray) -> PoseGraph:
    """Return a graph of two components, the second half in a frame of its own."""
    half = len(truth) // 2
    graph = PoseGraph()
    graph.add_first(0, truth[0])
    for m in measured(truth, [(i, i + 1) for i in range(half - 1)], 0.0):
        graph.add(m)
    graph.add_first(half, T_apart @ truth[half])
    for m in measured(truth, [(i, i + 1) for i in range(half, len(truth) - 1)], 0.0):
        graph.add(m)
    return graph


T_APART = se3.exp(np.array([0.1, -0.4, 0.2, 100.0, 3.0, -5.0]))


def test_components_keep_their_frames_until_they_are_merged() -> None:
    truth = circle(12)
    graph = two_components(truth, T_APART)
    assert [graph.component_root(k) for k in (0, 5, 6, 11)] == [0, 0, 6, 6]
    for keyframe, T in graph.poses().items():
        T_expected = truth[keyframe] if keyframe < 6 else T_APART @ truth[keyframe]
        np.testing.assert_allclose(T, T_expected, atol=1e-5)


@pytest.mark.parametrize("pair", [(2, 9), (9, 2)])
def test_closure_merges_the_newer_component_into_the_older(pair: tuple[int, int]) -> None:
    truth = circle(12)
    graph = two_components(truth, T_APART)
    graph.add_loop_closure(*measured(truth, [pair], 0.0))
    assert {graph.component_root(k) for k in range(12)} == {0}
    for keyframe, T in graph.poses().items():
        np.testing.assert_allclose(T, truth[keyframe], atol=1e-5)


def test_merged_graph_grows_the_same_after_a_restore() -> None:
    truth = circle(12)
    graph, restored = two_components(truth[:11], T_APART), PoseGraph()
    graph.add_loop_closure(*measured(truth, [(2, 9)], 0.0))
    restored.restore(graph.snapshot())
    for each in (graph, restored):
        each.add(*measured(truth, [(10, 11)], 0.0))
        each.add_loop_closure(*measured(truth, [(0, 11)], 0.0))
        np.testing.assert_allclose(each.pose(11), truth[11], atol=1e-5)
        assert each.component_root(11) == 0


# --- condensation ---------------------------------------------------------------------------------
UNCONDENSED = PoseGraphConfig(window_keyframes=10_000)  # Window too long for condensation.


def test_old_keyframes_are_condensed_to_one_variable_in_ten() -> None:
    truth = kitchen(150)
    graph = walked(truth[0], odometry(truth, 1, window=3, sigma=0.0))
    assert len(graph) == 150
    assert graph.variables == 150 - 9 * 12
    for keyframe, T in graph.poses().items():
        np.testing.assert_allclose(T, truth[keyframe], atol=1e-6)
        np.testing.assert_allclose(graph.pose(keyframe), T, atol=1e-9)


def test_condensed_graph_corrects_loops_like_the_uncondensed_one() -> None:
    """The reference is the graph of all keyframes and measurements."""
    truth = round_trips(240, 120)
    measured = list(odometry(truth, 3, window=3, drift_ratio=0.01, drift_rad_per_m=0.009))
    loops = closures(truth, 15, 100, 3)
    condensed, uncondensed = (
        walked(truth[0], measured, loops, config=c) for c in (None, UNCONDENSED)
    )
    errors_m = np.linalg.norm(
        condensed.all_poses()[1][:, :3, 3] - uncondensed.all_poses()[1][:, :3, 3], axis=1
    )
    drifted = ate_m(walked(truth[0], measured), truth)
    assert len(loops) == len(condensed.closures.accepted) == len(uncondensed.closures.accepted) == 8
    assert np.sqrt(np.mean(errors_m**2)) < 0.1 * drifted
    assert ate_m(condensed, truth) < 1.2 * ate_m(uncondensed, truth)


def test_loop_error_spreads_evenly_where_odometry_skips_the_previous_keyframe() -> None:
    """Every eleventh keyframe is not measured from the previous one.

    The reference is the graph of all keyframes.
    """
    truth = round_trips(240, 120)
    walk = odometry(truth, 3, window=3, sigma=1e-4, drift_ratio=0.01, drift_rad_per_m=0.009)
    measured = [[m for m in step if m.b % 11 or m.a != m.b - 1] for step in walk]
    loops = closures(truth, 15, 100, 3)
    condensed, uncondensed = (
        walked(truth[0], measured, loops, config=c) for c in (None, UNCONDENSED)
    )
    assert condensed.variables < 0.3 * uncondensed.variables

    def max_error_rad(graph: PoseGraph) -> float:
        poses = graph.all_poses()[1]
        return max(
            se3.rotation_angle(se3.inverse(se3.inverse(a) @ b) @ se3.inverse(c) @ d)
            for a, b, c, d in zip(poses, poses[1:], truth, truth[1:], strict=False)
        )

    assert max_error_rad(condensed) < 1.2 * max_error_rad(uncondensed)


@pytest.mark.parametrize("place_in_group", [5, 8])
def test_closure_constrains_a_condensed_keyframe_as_well_as_a_variable(place_in_group: int) -> None:
    """The closed keyframe is the fifth of ten, or one nearer to the end of the group.

    The reference is the graph of all keyframes.
    """
    truth = round_trips(240, 120)
    walk = odometry(truth, 3, window=3, sigma=1e-4, drift_ratio=0.01, drift_rad_per_m=0.009)
    measured = list(walk)
    loops = {
        b: RelativePose(b - 120, b, se3.inverse(truth[b - 120]) @ truth[b], REFINED)
        for b in range(130 + place_in_group, 240, 20)
    }
    condensed, uncondensed = (
        walked(truth[0], measured, loops, config=c) for c in (None, UNCONDENSED)
    )

    def error_m(graph: PoseGraph) -> float:
        errors = [
            se3.inverse(m.T_a_b) @ se3.inverse(graph.pose(m.a)) @ graph.pose(m.b)
            for m in loops.values()
        ]
        return float(np.mean([np.linalg.norm(T[:3, 3]) for T in errors]))

    assert error_m(condensed) < 1.5 * error_m(uncondensed)


def test_splitting_a_group_keeps_its_pose_and_information() -> None:
    truth = kitchen(60)
    graph = walked(truth[0], odometry(truth, 5, window=2))
    known, before = graph._known, graph.poses()
    unsplit = known.condensed[10, 20]
    assert not known.interpolation_error_sigmas(14, before) > 1e-6
    known.restore_variable(14)
    first, second = known.condensed[10, 14], known.condensed[14, 20]
    np.testing.assert_allclose(first.T_a_b @ second.T_a_b, unsplit.T_a_b, atol=1e-12)
    to_tail = se3.adjoint(se3.inverse(second.T_a_b))  # Maps a perturbation at 14 to one at 20.
    covariance = to_tail @ np.linalg.inv(first.information) @ to_tail.T
    covariance += np.linalg.inv(second.information)
    np.testing.assert_allclose(covariance, np.linalg.inv(unsplit.information), rtol=1e-6)
    # The other keyframes of the group stay in place on both sides of 14.
    assert 14 not in known.rows
    ends = {k: before[k] for k in (10, 14, 20)}
    for keyframe in (11, 12, 13, 15, 16, 17, 18, 19):
        condensed = known.interpolated.only(known.rows[keyframe])
        pair = int(condensed.start_variables[0]), int(condensed.end_variables[0])
        assert pair == ((10, 14) if keyframe < 14 else (14, 20))
        placed = condensed.interpolated_poses(*(ends[k][None] for k in pair))[0]
        np.testing.assert_allclose(placed, before[keyframe], atol=1e-9)
    np.testing.assert_allclose(known.interpolated.fractions[[known.rows[12], known.rows[17]]], 0.5)


def test_at_most_one_keyframe_in_five_becomes_a_variable_for_closures() -> None:
    truth = round_trips(240, 120)
    measured = list(odometry(truth, 3, window=3, drift_ratio=0.01, drift_rad_per_m=0.009))
    loops = closures(truth, 2, 100, 3)
    graph = walked(truth[0], measured, loops)
    assert len(graph._known.condensed) > 25  # Groups of ten would give 22.
    assert len(graph._known.condensed) <= 240 / 5


def test_group_ends_at_the_keyframe_that_the_next_is_measured_from() -> None:
    chain = [(k - 1, k) for k in range(1, 60)]
    assert group_to_condense(range(60), chain, (), 10, 20) == list(range(11))
    skips_10_and_11 = [(9 if b in (11, 12) else a, b) for a, b in chain]
    assert group_to_condense(range(60), skips_10_and_11, (), 10, 20) == list(range(13))
    from_the_first = [(0, k) for k in range(1, 60)]  # Keyframe 0 is every reference.
    assert group_to_condense(range(60), from_the_first, (), 10, 20) == list(range(21))
    assert group_to_condense(range(11), chain, (), 10, 0) == list(range(11))  # The last group.
    ends_at_10 = [pair for pair in chain if pair != (10, 11)]  # Tracking is lost after 10.
    assert group_to_condense(range(60), ends_at_10, (), 10, 20) == list(range(11))


def test_interpolation_covariance_is_expressed_at_the_measured_end() -> None:
    truth = kitchen(60)
    graph = walked(truth[0], odometry(truth, 1))
    known, far = graph._known, 59
    keyframe = next(
        k for k in known.rows if known.relative_to_variable(k)[0] == known.relative_to_start(k)[0]
    )
    T_far_keyframe = se3.inverse(truth[far]) @ truth[keyframe]
    forward = RelativePose(far, keyframe, T_far_keyframe, REFINED)
    backward = RelativePose(keyframe, far, se3.inverse(T_far_keyframe), REFINED)
    covariance, adjoint = known._ends_covariance(forward), se3.adjoint(T_far_keyframe)
    transformed = adjoint @ covariance @ adjoint.T
    np.testing.assert_allclose(known._ends_covariance(backward), transformed, rtol=1e-9, atol=1e-15)
    head, _ = known.relative_to_start(keyframe)
    known.restore_variable(keyframe)
    as_variable = np.linalg.inv(known.condensed[head, keyframe].information)
    np.testing.assert_allclose(covariance, as_variable, rtol=1e-6, atol=1e-15)


def test_measurement_of_a_condensed_keyframe_keeps_that_of_its_variable() -> None:
    truth = kitchen(81)
    graph = walked(truth[0], odometry(truth[:80], 1, sigma=0.0))
    assert {10, 20}.isdisjoint(graph._known.rows)
    exact = RelativePose(20, 80, se3.inverse(truth[20]) @ truth[80], REFINED)
    T_error = se3.exp(np.array([0, 0, 0, 0.05, 0, 0]))
    wrong = RelativePose(19, 80, se3.inverse(truth[19]) @ truth[80] @ T_error, REFINED)
    for order in ((exact, wrong), (wrong, exact)):
        restored = PoseGraph()
        restored.restore(decode_state(encode_state(graph.snapshot())))
        restored.add(*order)
        np.testing.assert_allclose(restored.pose(80), truth[80], atol=1e-5)


def test_closure_within_a_group_survives_its_condensation() -> None:
    """A closure connects 2 and 9 before their group is condensed.

    A later closure within the condensed group has no effect and is rejected. The reference is the
    graph of all keyframes.
    """
    truth = kitchen(60)
    measured = list(odometry(truth, 5, window=2, sigma=2e-2))
    loops = {9: RelativePose(2, 9, se3.inverse(truth[2]) @ truth[9], REFINED)}
    condensed, uncondensed = (
        walked(truth[0], measured, loops, config=c) for c in (None, UNCONDENSED)
    )
    odometry_only = walked(truth[0], measured)

    def error_m(graph: PoseGraph) -> float:
        T_2_9 = se3.inverse(graph.pose(2)) @ graph.pose(9)
        return float(np.linalg.norm((se3.inverse(loops[9].T_a_b) @ T_2_9)[:3, 3]))

    assert error_m(condensed) < 1.1 * error_m(uncondensed) + 1e-4
    assert error_m(condensed) < 0.5 * error_m(odometry_only)
    before = condensed.poses()
    late = RelativePose(3, 8, se3.inverse(truth[3]) @ truth[8], REFINED)
    assert not condensed.add_loop_closure(late).is_accepted
    assert all((condensed.pose(k) == T).all() for k, T in before.items())


def test_restored_condensed_graph_continues_bitwise_equal() -> None:
    truth = round_trips(150, 60)
    measured = list(odometry(truth, 4, window=3))
    loops = closures(truth, 7, 40, 4)
    for saved_at in (64, 111, 141):
        first = walked(truth[0], measured[: saved_at - 1], loops)
        second = PoseGraph()
        second.restore(decode_state(encode_state(first.snapshot())))
        for graph in (first, second):
            for measurements in measured[saved_at - 1 :]:
                graph.add(*measurements)
                if (newest := measurements[0].b) in loops:
                    graph.add_loop_closure(loops[newest])
        np.testing.assert_array_equal(first.all_poses()[1], second.all_poses()[1])
        assert encode_state(first.snapshot()) == encode_state(second.snapshot())


def test_replaced_measurement_moves_a_condensed_keyframe() -> None:
    truth = kitchen(60)
    graph = walked(truth[0], odometry(truth, 1, sigma=0.0))
    T_3_4 = se3.inverse(truth[3]) @ truth[4] @ se3.exp(np.array([0, 0.01, 0, 0.02, 0, 0]))
    graph.replace([RelativePose(3, 4, T_3_4, INFORMATION)])
    np.testing.assert_allclose(graph.pose(4), truth[3] @ T_3_4, atol=1e-6)
    np.testing.assert_allclose(graph.pose(5), truth[5], atol=1e-6)


def test_keyframe_measured_only_from_a_condensed_one_keeps_its_pose() -> None:
    truth = kitchen(60)
    graph = PoseGraph()
    graph.add_first(0, truth[0])
    for b in range(1, 60):
        a = 5 if b == 25 else b - 1
        graph.add(RelativePose(a, b, se3.inverse(truth[a]) @ truth[b], INFORMATION))
    for keyframe, T in graph.poses().items():
        np.testing.assert_allclose(T, truth[keyframe], atol=1e-5)


def test_failed_update_is_solved_again_from_the_stored_factors(monkeypatch) -> None:
    truth = kitchen(12)
    measured = list(odometry(truth, 1))
    graph, reference = (walked(truth[0], measured[:9]) for _ in range(2))
    update, calls = type(graph._solver).update, []

    def fails_once(*arguments: object) -> None:
        calls.append(arguments)
        update(*arguments)
        if len(calls) == 1:
            raise RuntimeError("half way through")

    monkeypatch.setattr(type(graph._solver), "update", fails_once)
    graph.add(*measured[9])
    monkeypatch.undo()
    reference.add(*measured[9])
    assert len(calls) == 2
    np.testing.assert_allclose(graph.all_poses()[1], reference.all_poses()[1], atol=1e-6)


def test_incremental_poses_with_a_loop_equal_a_batch_solution_of_the_objective() -> None:
    """The reference is SciPy on the residuals that `ldo_service.pose_graph` states."""
    truth = round_trips(14, 11, radius_m=1.0)
    measured = list(odometry(truth, 2, sigma=5e-3))
    loop = RelativePose(0, 11, se3.inverse(truth[0]) @ truth[11] @ se3.exp(np.full(6, 4e-3)), LOOP)
    noise = NoiseConfig(drift_rad_per_sqrt_m=0, drift_m_per_sqrt_m=0)
    graph = walked(truth[0], measured, {11: loop}, config=PoseGraphConfig(noise))

    def residuals(x: np.ndarray) -> np.ndarray:
        T = [truth[0], *(truth[i] @ se3.exp(x[6 * i - 6 : 6 * i]) for i in range(1, 14))]
        out = []
        for m in [m for step in measured for m in step]:
            root = np.linalg.cholesky(m.information + noise.floor).T
            out.append(root @ se3.log(se3.inverse(m.T_a_b) @ se3.inverse(T[m.a]) @ T[m.b]))
        e = se3.log(se3.inverse(loop.T_a_b) @ se3.inverse(T[0]) @ T[11])
        d2 = e @ np.linalg.inv(np.linalg.inv(LOOP + noise.floor) + 1e-4 * np.eye(6)) @ e
        k = noise.robust_sigmas
        return np.concatenate([*out, [np.sqrt(k**2 * np.log1p(d2 / k**2))]])

    x = scipy.optimize.least_squares(residuals, np.zeros(78), xtol=1e-14, ftol=1e-14).x
    for i in range(1, 14):
        np.testing.assert_allclose(
            graph.pose(i), truth[i] @ se3.exp(x[6 * i - 6 : 6 * i]), atol=2e-4
        )


def test_keyframe_that_heads_a_group_is_never_condensed_itself() -> None:
    """Odometry continues from 0 and skips 2, until a measurement connects 2 to the head 5."""
    graph = PoseGraph(PoseGraphConfig(condense_keyframes=2, window_keyframes=2))
    truth = [se3.exp(np.array([0.0, 0.1 * k, 0.0, 0.1 * k, 0.0, 0.0])) for k in range(14)]

    def exact(a: int, b: int) -> RelativePose:
        return RelativePose(a, b, se3.inverse(truth[a]) @ truth[b], 1e4 * np.eye(6))

    graph.add_first(0, truth[0])
    references = {3: [0], 5: [4, 2], 9: [8, 2]}
    for b in range(1, 14):
        graph.add(*(exact(a, b) for a in references.get(b, [b - 1])))
    poses = graph.poses()
    assert sorted(poses) == list(range(14))
    assert graph.variables < 14
    for k, T_map_keyframe in poses.items():
        np.testing.assert_allclose(T_map_keyframe, truth[k], atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_every_stored_factor_connects_two_variables_and_is_restored(seed: int) -> None:
    """A random sequence of submaps, old references, refinements and closures of any pair."""
    rng, truth = np.random.default_rng(seed), kitchen(80)
    graph = PoseGraph()
    graph.add_first(0, truth[0])

    def noisy(a: int, b: int) -> RelativePose:
        noise = se3.exp(rng.normal(scale=1e-3, size=6))
        return RelativePose(a, b, se3.inverse(truth[a]) @ truth[b] @ noise, INFORMATION)

    def connected(before: int) -> list[int]:
        return [
            k for k in range(before) if graph.component_root(k) == graph.component_root(before - 1)
        ]

    for b in range(1, 80):
        if rng.random() < 0.03:
            graph.add_first(b, truth[b])
        else:
            known = connected(b)
            chosen = {*rng.choice(known[-4:], 2).tolist()}
            chosen |= {int(rng.choice(known))} if rng.random() < 0.05 else set()
            graph.add(*(noisy(a, b) for a in sorted(chosen, reverse=True)))
        for _ in range(int(rng.integers(3))):
            graph.add_loop_closure(noisy(*sorted(rng.choice(b + 1, 2, replace=False).tolist())))
        if rng.random() < 0.2 and (earlier := connected(b + 1)[:-1]):
            graph.replace([noisy(earlier[-1], b)])
        known = graph._known
        for kind in ("odometry", "condensed", "bridges"):
            for m in getattr(known, kind).values():
                assert len({end for end, _ in known.ends(m)}) == 2
        for m in graph.closures.accepted.values():
            assert len({end for end, _ in known.ends(m)}) == 2
    restored = PoseGraph()
    restored.restore(decode_state(encode_state(graph.snapshot())))
    np.testing.assert_array_equal(restored.all_poses()[1], graph.all_poses()[1])
    errors_m = np.linalg.norm((graph.all_poses()[1] - np.array(truth))[:, :3, 3], axis=1)
    first = [k for k in range(80) if graph.component_root(k) == 0]
    assert errors_m[first].max() < 0.05
