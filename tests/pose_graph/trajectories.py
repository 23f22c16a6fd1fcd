"""Ground-truth trajectories, with drifting odometry and loop closures of them."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import RelativePose
from ldo_service.pose_graph.pose_graph import PoseGraph
from ldo_service.pose_graph.pose_graph_config import PoseGraphConfig

ODOMETRY = np.diag([2e3**2] * 3 + [5e2**2] * 3)  # 0.5 mrad and 2 mm, as from alignment.
REFINED = np.diag([2e2**2] * 3 + [1e2**2] * 3)  # 5 mrad and 1 cm, as of a closure.


def looking_along(positions: np.ndarray, ahead: np.ndarray) -> list[np.ndarray]:
    """Return T_map_camera [4, 4] of each position, z along `ahead` [N, 3], y down as in the map."""
    z = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    T = np.tile(np.eye(4), (len(positions), 1, 1))
    T[:, :3, :3] = np.stack([x, np.cross(z, x), z], axis=2)
    T[:, :3, 3] = positions
    return list(T)


def kitchen(count: int = 180) -> list[np.ndarray]:
    """Return poses of a handheld camera that sways through a room of 3 m and often comes back."""
    t = np.linspace(0, 1, count)
    positions = np.column_stack(
        [
            1.5 * np.sin(2 * np.pi * 4 * t),
            0.2 * np.sin(2 * np.pi * 6 * t),
            1.1 * np.sin(2 * np.pi * 2 * t + 0.5),
        ]
    )
    yaw = 0.9 * np.sin(2 * np.pi * 2 * t)
    ahead = np.column_stack([np.sin(yaw), 0.25 * np.sin(2 * np.pi * 4 * t), np.cos(yaw)])
    return looking_along(positions, ahead)


def round_trips(count: int, each: int, radius_m: float = 3.0) -> list[np.ndarray]:
    """Return poses along a circle, `each` keyframes per round, looking ahead."""
    angle = 2 * np.pi * np.arange(count) / each
    positions = radius_m * np.column_stack([np.sin(angle), 0.1 * np.sin(5 * angle), np.cos(angle)])
    ahead = np.column_stack([np.cos(angle), np.zeros(count), -np.sin(angle)])
    return looking_along(positions, ahead)


def between(truth: Sequence[np.ndarray], a: int, b: int) -> np.ndarray:
    return se3.inverse(truth[a]) @ truth[b]


def odometry(
    truth: Sequence[np.ndarray],
    seed: int,
    *,
    window: int = 1,
    sigma: float = 2e-3,
    drift_ratio: float = 0.0,
    drift_rad_per_m: float = 0.0,
) -> Iterator[list[RelativePose]]:
    """Yield the odometry measurements of each keyframe but the first.

    Each keyframe is measured from the `window` keyframes before it, with noise. One drift holds
    for the whole walk: longer steps, and a rotation about a fixed axis.
    """
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    for b in range(1, len(truth)):
        measured = []
        for a in range(b - 1, max(b - 1 - window, -1), -1):
            T = between(truth, a, b)
            path_m = np.linalg.norm(T[:3, 3])
            T = T @ se3.exp(np.r_[drift_rad_per_m * path_m * axis, np.zeros(3)])
            T[:3, 3] *= 1 + drift_ratio
            T = T @ se3.exp(rng.normal(scale=sigma, size=6))
            measured.append(RelativePose(a, b, T, ODOMETRY))
        yield measured


def closures(
    truth: Sequence[np.ndarray], every: int, apart: int, seed: int, *, near_m: float = 0.6
) -> dict[int, RelativePose]:
    """Return true closures by newer keyframe.

    Each `every`-th keyframe closes with the nearest one that is at least `apart` older, where
    translation (m) plus rotation (rad) is below `near_m`.
    """
    rng, found = np.random.default_rng(seed), {}
    for b in range(apart, len(truth), every):
        T = [between(truth, a, b) for a in range(b - apart)]
        distances = [np.linalg.norm(T_a_b[:3, 3]) + se3.rotation_angle(T_a_b) for T_a_b in T]
        a = int(np.argmin(distances)) if distances else 0
        if distances and distances[a] < near_m:
            noise = rng.normal(size=6) * ([5e-3] * 3 + [1e-2] * 3)
            found[b] = RelativePose(a, b, T[a] @ se3.exp(noise), REFINED)
    return found


def false_closures(
    truth: Sequence[np.ndarray], newer: Iterable[int], apart: int, seed: int
) -> dict[int, RelativePose]:
    """Return false closures by newer keyframe, with an old keyframe of another place."""
    rng, found = np.random.default_rng(seed), {}
    for b in newer:
        far = [a for a in range(b - apart) if np.linalg.norm(between(truth, a, b)[:3, 3]) > 1.0]
        T = se3.exp(rng.normal(size=6) * ([0.1] * 3 + [0.1] * 3))
        found[b] = RelativePose(int(rng.choice(far)), b, T, REFINED)
    return found


def walked(
    first: np.ndarray,
    measured: Iterable[list[RelativePose]],
    *loops: dict[int, RelativePose],
    config: PoseGraphConfig | None = None,
) -> PoseGraph:
    """Return the pose graph of odometry measurements, with closures by newer keyframe."""
    graph = PoseGraph(config or PoseGraphConfig())
    graph.add_first(0, first)
    for measurements in measured:
        graph.add(*measurements)
        newest = measurements[0].b
        for found in loops:
            if newest in found:
                graph.add_loop_closure(found[newest])
    return graph


def ate_m(graph: PoseGraph, truth: Sequence[np.ndarray]) -> float:
    """Return the RMSE of the positions after the best rigid alignment."""
    keyframes, T_map = graph.all_poses()
    estimated, true = T_map[:, :3, 3], np.array([truth[k] for k in keyframes])[:, :3, 3]
    a, b = estimated - estimated.mean(axis=0), true - true.mean(axis=0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    R = (U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt).T
    return float(np.sqrt(np.mean(np.sum((a @ R.T - b) ** 2, axis=1))))
