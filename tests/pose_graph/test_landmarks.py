"""Tests of landmark triangulation, optimization, labels and removal."""

from dataclasses import replace

import numpy as np
import pytest

from ldo_service.geometry import Camera, se3
from ldo_service.pose_graph.factors import NoiseConfig, odometry_information
from ldo_service.pose_graph.landmarks import (
    MAX_CLASSES,
    LandmarkObservation,
    ObjectLandmarkConfig,
    ObjectLandmarks,
    triangulate,
)
from ldo_service.pose_graph.pose_graph import PoseGraph
from ldo_service.pose_graph.pose_graph_config import PoseGraphConfig
from ldo_service.pose_graph.solver import point_key, solve_batch
from ldo_service.storage.state_codec import decode_state, encode_state

from .trajectories import ate_m, kitchen, odometry, walked

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
CAMERA_PARAMETERS = np.array([640, 480, 525.0, 525.0, 319.5, 239.5])
OBJECTS = np.array([[-0.6, 0.2, 3.0], [0.5, 0.0, 3.4], [0.1, -0.5, 3.8], [1.2, 0.4, 3.1]])
CONFIDENT, VAGUE = np.full(MAX_CLASSES, 0.05 / 255), np.full(MAX_CLASSES, 0.6 / 255)
CONFIDENT[7], VAGUE[7] = 0.95, 0.4


def entropy(p: np.ndarray) -> float:
    return float(-(p * np.log(p)).sum())


def observed_boxes(
    truth: list[np.ndarray],
    keyframe: int,
    rng: np.random.Generator,
    sigma_px: float = 3.0,
    p: np.ndarray = CONFIDENT,
) -> list[LandmarkObservation]:
    """Return boxes of 60 px around the projected centers of the visible objects."""
    out = []
    for k, center in enumerate(OBJECTS):
        p_camera = se3.transform(se3.inverse(truth[keyframe]), center)
        u, v = CAMERA.project(p_camera[None])[0] + rng.normal(scale=sigma_px, size=2)
        if p_camera[2] > 0.5 and 40 < u < 600 and 40 < v < 440:
            box_px = np.array([u - 30, v - 30, u + 30, v + 30])
            out.append(
                LandmarkObservation(keyframe, k, box_px, p, entropy(p), False, CAMERA_PARAMETERS)
            )
    return out


def graph_with_landmarks(
    truth: list[np.ndarray],
    config: ObjectLandmarkConfig,
    p: np.ndarray = CONFIDENT,
    sigma: float = 2e-3,
    noise: NoiseConfig | None = None,
) -> tuple[PoseGraph, ObjectLandmarks]:
    """Return the pose graph and the landmarks after a walk with odometry and object boxes."""
    noise = noise or NoiseConfig()
    graph, landmarks = PoseGraph(PoseGraphConfig(noise)), ObjectLandmarks(config, noise)
    rng = np.random.default_rng(8)
    graph.add_first(0, truth[0])
    for measurements in odometry(truth, 1, sigma=sigma):
        if landmarks.needs_update():
            landmarks.update_graph(graph)
        graph.add(*measurements)
        for observation in observed_boxes(truth, measurements[0].b, rng, p=p):
            landmarks.observe(observation)
    landmarks.update_graph(graph)
    return graph, landmarks


def test_triangulate_recovers_the_common_point_of_exact_rays() -> None:
    rng = np.random.default_rng(0)
    origins, point = rng.normal(size=(5, 3)), np.array([1.0, 2.0, 5.0])
    found, angle = triangulate(origins, point - origins)
    np.testing.assert_allclose(found, point, atol=1e-12)
    assert 0 < angle < np.pi


def test_landmarks_converge_to_the_object_centers() -> None:
    graph, landmarks = graph_with_landmarks(kitchen(90), ObjectLandmarkConfig(), sigma=0.0)
    found = graph.landmarks()
    assert list(found) == sorted(landmarks.known) == [0, 1, 2, 3]
    np.testing.assert_allclose(list(found.values()), OBJECTS, atol=0.05)


def test_landmarks_reduce_the_error_of_drifting_odometry() -> None:
    """The errors of the observations are independent."""
    truth, noise = kitchen(120), NoiseConfig(independent_observations=1.0)
    graph, _ = graph_with_landmarks(truth, ObjectLandmarkConfig(), sigma=8e-3, noise=noise)
    alone = walked(truth[0], odometry(truth, 1, sigma=8e-3))
    assert ate_m(graph, truth) < 0.7 * ate_m(alone, truth)


def test_boxes_occluded_on_one_side_barely_bend_exact_odometry() -> None:
    """A third of each box is hidden while its object is in the left half of the image.

    All observations from there have the same error. Counted as independent, they bend the
    trajectory by 18 mm.
    """
    truth, rng = kitchen(120), np.random.default_rng(8)
    graph = PoseGraph(PoseGraphConfig())
    landmarks = ObjectLandmarks(ObjectLandmarkConfig(), NoiseConfig())
    graph.add_first(0, truth[0])
    for measurements in odometry(truth, 1, sigma=1e-6):
        if landmarks.needs_update():
            landmarks.update_graph(graph)
        graph.add(*measurements)
        for observation in observed_boxes(truth, measurements[0].b, rng, sigma_px=0.0):
            x0, y0, x1, y1 = observation.box_px
            hidden_px = 20 if x0 < 320 else 0
            cut_px = np.array([x0 + hidden_px, y0, x1, y1])
            landmarks.observe(replace(observation, box_px=cut_px))
    landmarks.update_graph(graph)
    assert len(graph.landmarks()) >= 3
    assert ate_m(graph, truth) < 0.004


def test_poses_and_landmarks_equal_a_batch_solution_of_the_objective() -> None:
    """The reference is Levenberg-Marquardt started at the ground truth.

    No step away from its solution lowers the objective that `ldo_service.pose_graph` states,
    computed here in NumPy.
    """
    truth, rng, noise = kitchen(60)[:30:3], np.random.default_rng(2), NoiseConfig()
    measured = [m for measurements in odometry(truth, 2) for m in measurements]
    graph = walked(truth[0], ([m] for m in measured))
    landmarks = ObjectLandmarks(ObjectLandmarkConfig(schedule="fixed"), noise)
    for k in range(10):
        for observation in observed_boxes(truth, k, rng):
            landmarks.observe(observation)
    landmarks.update_graph(graph)
    observations = [s for k in graph.landmarks() for s in landmarks.known[k].observations]
    assert len(graph.landmarks()) >= 3

    def cost(T: list[np.ndarray], centers: dict[int, np.ndarray]) -> float:
        total, k = 0.0, noise.robust_sigmas
        for m in measured:
            error = se3.log(se3.inverse(m.T_a_b) @ se3.inverse(T[m.a]) @ T[m.b])
            total += error @ odometry_information(m, noise) @ error
        for s in observations:
            p_camera = se3.transform(se3.inverse(T[s.keyframe]), centers[s.landmark])
            error_px = CAMERA.project(p_camera[None])[0] - s.center_px
            rho = k**2 * np.log1p(s.weight * (error_px @ error_px) / (s.sigma_px * k) ** 2)
            total += noise.independent_observations * rho
        return total

    start = {i: truth[i] for i in range(10)}
    start |= {point_key(k): OBJECTS[k] for k in graph.landmarks()}
    variables, _ = solve_batch(graph._known.with_closures((), graph._initial), start)
    T = [variables[i] for i in range(10)]
    centers = {k: variables[point_key(k)] for k in graph.landmarks()}
    min_cost = cost(T, centers)
    for _ in range(40):
        moved = [T[0], *(T_k @ se3.exp(rng.normal(scale=1e-3, size=6)) for T_k in T[1:])]
        assert cost(moved, centers) > min_cost
        shifted = {k: p + rng.normal(scale=1e-2, size=3) for k, p in centers.items()}
        assert cost(T, shifted) > min_cost
    for i in range(10):
        np.testing.assert_allclose(graph.pose(i), T[i], atol=2e-3)
    for k, center in graph.landmarks().items():
        np.testing.assert_allclose(center, centers[k], atol=1e-2)


@pytest.mark.parametrize(("angle_rad", "is_known"), [(0.0, False), (0.05, False), (0.3, True)])
def test_landmark_enters_the_graph_only_with_enough_parallax(
    angle_rad: float, is_known: bool
) -> None:
    truth = [np.eye(4) for _ in range(4)]
    for k in range(4):
        truth[k][0, 3] = 3.4 * np.tan(angle_rad) * k / 3
    graph = walked(truth[0], odometry(truth, 1, sigma=0.0))
    landmarks = ObjectLandmarks(ObjectLandmarkConfig(), NoiseConfig())
    for k in range(4):
        for observation in observed_boxes(truth, k, np.random.default_rng(k), sigma_px=0.0):
            landmarks.observe(observation)
    landmarks.update_graph(graph)
    assert graph.has_landmark(1) == is_known
    assert 1 in landmarks.known


def test_box_at_the_image_border_adds_a_label_but_no_position() -> None:
    box_px = np.array([0.0, 100, 60, 160])
    observation = LandmarkObservation(0, 5, box_px, CONFIDENT, 0.3, False, CAMERA_PARAMETERS)
    landmarks, graph = ObjectLandmarks(ObjectLandmarkConfig(), NoiseConfig()), walked(np.eye(4), [])
    landmarks.observe(observation)
    landmarks.update_graph(graph)
    assert landmarks.known[5].observations == ()
    assert landmarks.known[5].distribution.argmax() == 7


def test_repeated_observation_counts_once() -> None:
    truth = kitchen(40)
    graph, landmarks = graph_with_landmarks(truth, ObjectLandmarkConfig())
    known = dict(landmarks.known)
    k, landmark = next(item for item in known.items() if graph.has_landmark(item[0]))
    repeated = observed_boxes(truth, landmark.observations[0].keyframe, np.random.default_rng(8))
    for observation in repeated:
        landmarks.observe(observation)
    landmarks.update_graph(graph)
    assert landmarks.known[k].evidence == known[k].evidence
    assert landmarks.known[k].observations == known[k].observations


def test_landmark_is_removed_after_ten_misses_and_a_vague_one_after_five() -> None:
    truth = kitchen(60)
    for p, misses in ((CONFIDENT, 10), (VAGUE, 5)):
        graph, landmarks = graph_with_landmarks(truth, ObjectLandmarkConfig(due_weight=0.01), p=p)
        assert graph.has_landmark(0)
        miss = LandmarkObservation(59, 0, np.zeros(4), p, entropy(p), True, CAMERA_PARAMETERS)
        for count in range(1, misses + 1):
            landmarks.observe(miss)
            landmarks.update_graph(graph)
            assert graph.has_landmark(0) == (0 in landmarks.known) == (count < misses)
        assert graph.landmarks().keys() == landmarks.known.keys()


def test_adaptive_schedule_solves_less_often_with_equally_good_poses() -> None:
    truth = kitchen(90)
    errors, times = {}, {}
    for schedule in ("fixed", "adaptive"):
        config = ObjectLandmarkConfig(schedule=schedule)
        graph, landmarks = graph_with_landmarks(truth, config, p=VAGUE, sigma=8e-3)
        errors[schedule], times[schedule] = ate_m(graph, truth), graph.solved_times
        assert (landmarks.skipped > 0) == (schedule == "adaptive")
    assert times["adaptive"] < times["fixed"]
    assert errors["adaptive"] < 1.1 * errors["fixed"]


def test_restored_landmarks_continue_bitwise_equal() -> None:
    truth, rng = kitchen(70), np.random.default_rng(1)
    graph, landmarks = graph_with_landmarks(truth[:60], ObjectLandmarkConfig())
    for observation in observed_boxes(truth, 59, rng):
        landmarks.observe(observation)
    restored_graph, restored = PoseGraph(), ObjectLandmarks(ObjectLandmarkConfig(), NoiseConfig())
    restored_graph.restore(decode_state(encode_state(graph.snapshot())))
    restored.restore(decode_state(encode_state(landmarks.snapshot())))
    for continued, known in ((graph, landmarks), (restored_graph, restored)):
        known.update_graph(continued)
        for measurements in list(odometry(truth, 1))[59:]:
            continued.add(*measurements)
    np.testing.assert_array_equal(graph.all_poses()[1], restored_graph.all_poses()[1])
    assert encode_state(landmarks.snapshot()) == encode_state(restored.snapshot())


def test_landmark_that_cannot_be_solved_is_dropped_and_poses_stay(monkeypatch) -> None:
    truth = kitchen(40)
    graph, _ = graph_with_landmarks(truth, ObjectLandmarkConfig())
    build, failures = type(graph)._rebuild, []

    def fails_with_landmarks(self: PoseGraph) -> None:
        if self._known.observations:
            failures.append(self)
            raise RuntimeError("indeterminate")
        build(self)

    monkeypatch.setattr(type(graph), "_rebuild", fails_with_landmarks)
    graph._restart_solver(graph._solver.variables())
    assert failures
    assert graph.landmarks() == {}
    assert ate_m(graph, truth) < 0.05


def test_number_of_observations_per_landmark_is_bounded() -> None:
    graph, landmarks = graph_with_landmarks(
        kitchen(120), ObjectLandmarkConfig(max_observations=8, due_weight=1)
    )
    assert {len(landmark.observations) for landmark in landmarks.known.values()} == {8}
    assert len(graph._known.observations) == 8 * len(graph.landmarks())
