"""CPU time of a loop closure in mapper and optimizer, and of a keyframe in a long pose graph.

    python -m tests.bench.bench_correction [--gaussians 300000] [--keyframes 300] [--repeats 10]

The first part measures the mapping thread. A correction moves every keyframe of a map, from the
message to the moved Gaussians. Then one keyframe is deduplicated where 12 keyframes cover each
surface. The second part measures the optimizer as the pose graph grows. It times a keyframe
(solution, poses, message), a loop closure, and a receiver that applies the correction. All times
are CPU ms of this process, median and maximum.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np

from ldo_service.conversions.poses import correction_to_message, keyframe_poses_from_correction
from ldo_service.gaussians.model import GaussianMap
from ldo_service.gaussians.pruning import find_duplicates
from ldo_service.gaussians.rows import aligned_rows
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import KeyframePoses, RelativePose
from ldo_service.pose_graph.pose_graph import PoseGraph
from ldo_service.schemas import GraphCorrection, decode, encode
from tests.pose_graph.trajectories import REFINED, between, odometry, round_trips

ROOM_M, SPACING_M, OVER_EACH_OTHER = 6.0, 0.02, 12
EVERY = 200  # Keyframes between two rows of the table.


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gaussians", type=int, default=300_000)
    parser.add_argument("--keyframes", type=int, default=300)
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--journey", type=int, default=10_000)
    options = parser.parse_args()
    print(f"{options.gaussians} Gaussians on {options.keyframes} keyframes; CPU ms, median and max")
    measure_mapper(options.gaussians, options.keyframes, options.repeats)
    print("\n| keyframes | variables | keyframe ms | closure ms | apply ms | message kB |")
    print("|---|---|---|---|---|---|")
    measure_journey(options.journey)


# --- the mapper -----------------------------------------------------------------------------------
def measure_mapper(gaussians: int, keyframes: int, repeats: int) -> None:
    rng = np.random.default_rng(0)
    world, poses = walls(gaussians, keyframes, rng), placed(keyframes)
    T_map = {k: poses[k] for k in range(keyframes)}

    def correct(number: int) -> None:
        shift = se3.exp(rng.normal(size=6) * 0.01)
        message = correction_to_message(0, number + 1, {k: shift @ T for k, T in T_map.items()})
        body = encode(message)
        start = time.process_time()
        received = keyframe_poses_from_correction(decode(body, GraphCorrection))
        before = poses.of(T_map)
        poses.correct(number + 1, received)
        T_new_old = poses.of(T_map) @ se3.inverse(before)
        world.move_anchors(dict(zip(T_map, T_new_old, strict=True)))
        took.append(1e3 * (time.process_time() - start))

    took: list[float] = []
    for number in range(repeats):
        correct(number)
    print(f"correct and move   {np.median(took):7.1f} {max(took):7.1f}")
    newest = [keyframes - 1 - i for i in range(repeats)]
    times = milliseconds(lambda i: find_duplicates(world.rows, world.anchors, newest[i]), repeats)
    share = np.mean(
        find_duplicates(world.rows, world.anchors, newest[0])[world.anchors == newest[0]]
    )
    print(
        f"deduplicate        {np.median(times):7.1f} {max(times):7.1f}   {share:.0%} of it merged"
    )


def walls(gaussians: int, keyframes: int, rng: np.random.Generator) -> GaussianMap:
    """Return a map of wall patches, one per keyframe, each place covered by several keyframes."""
    world, each = GaussianMap(gaussians), gaussians // keyframes
    side, places = int(np.sqrt(each)), keyframes // OVER_EACH_OTHER
    for k in range(keyframes):
        grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)
        rows = aligned_rows(len(grid))
        rows[:, :2] = SPACING_M * (grid + 0.3 * rng.random(2))
        rows[:, 0] += side * SPACING_M * (k % places)
        rows[:, 2] = 0.005 * rng.normal()
        rows[:, 3:6] = np.log(0.6 * SPACING_M * np.array([1, 1, 0.1]))
        rows[:, 6], rows[:, 10], rows[:, 11:14] = 1, 3, 0.5
        world.add(rows, k)
    return world


def placed(keyframes: int) -> KeyframePoses:
    poses = KeyframePoses()
    for k in range(keyframes):
        poses.add(k, k - 1 if k else None, se3.exp(np.r_[np.zeros(5), 0.1]), np.eye(4))
    return poses


# --- the optimizer --------------------------------------------------------------------------------
def measure_journey(keyframes: int) -> None:
    truth = round_trips(keyframes, 180)
    graph, receiver, version = PoseGraph(), KeyframePoses(), 0
    graph.add_first(0, truth[0])
    receiver.add(0, None, np.eye(4), truth[0])
    keyframe_ms, closure_ms, take_ms, size_kb = [], [], [], 0.0
    for measured in odometry(truth, 0, window=3, drift_ratio=0.005, drift_rad_per_m=0.004):
        b, version = measured[0].b, version + 1
        receiver.add(b, b - 1, measured[0].T_a_b, truth[b])
        start = time.process_time()
        graph.add(*measured)
        body = encode(correction_to_message(0, version, graph.poses()))
        keyframe_ms.append(1e3 * (time.process_time() - start))
        if b % 60 == 0 and b > 180:
            start = time.process_time()
            graph.add_loop_closure(RelativePose(b - 180, b, between(truth, b - 180, b), REFINED))
            closure_ms.append(1e3 * (time.process_time() - start))
        if b % 20 == 0 or b % EVERY > EVERY - 5:
            start = time.process_time()
            receiver.correct(version, keyframe_poses_from_correction(decode(body, GraphCorrection)))
            take_ms.append(1e3 * (time.process_time() - start))
            size_kb = len(body) / 1e3
        if b in (EVERY, 1000, 2000, 5000, keyframes - 1):
            columns = (keyframe_ms[-EVERY:], closure_ms[-3:] or [0.0], take_ms[-10:])
            cells = " | ".join(f"{np.median(c):.1f} {max(c):.1f}" for c in columns)
            print(f"| {b + 1} | {graph.variables} | {cells} | {size_kb:.0f} |", flush=True)


def milliseconds(call: Callable[[int], object], repeats: int) -> list[float]:
    times = []
    for number in range(repeats):
        start = time.process_time()
        call(number)
        times.append(1e3 * (time.process_time() - start))
    return times


if __name__ == "__main__":
    main()
