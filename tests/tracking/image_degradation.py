"""Frames that went bad, and what tracking makes of them.

    python -m tests.tracking.image_degradation SOURCE [FRAMES]      prints the table of all troubles

A `Degrader` is a pure function: what the camera shows in place of frame k while there is trouble.
"""

import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ldo_service.datasets import Sequence, open_sequence
from ldo_service.evaluation.trajectory import fit_rigid_transform
from ldo_service.geometry import RawFrame, RgbdFrame, associate, rectify, se3
from ldo_service.tracking import Odometry, TrackingStatus

Frames = Callable[[int], RgbdFrame]
Degrader = Callable[[Frames, int], RgbdFrame | None]  # None: nothing arrives

BLOCKS = (6, 8)  # rows and columns of depth that is missing or not
TRUTH_WITHIN_S = 0.020
HEADER = """\
| trouble | OK % | OK % meanwhile | worst cm (frame) | ATE cm | OK again after |
|---|---|---|---|---|---|"""


# --- degraders ------------------------------------------------------------------------------------
def dropped(_frames: Frames, _k: int) -> None:
    return None


def covered(frames: Frames, k: int) -> RgbdFrame:
    """A hand over the lens: black, no depth."""
    frame = frames(k)
    return replace(frame, color=np.zeros_like(frame.color), depth_m=np.zeros_like(frame.depth_m))


def without_depth_in_blocks(frames: Frames, k: int) -> RgbdFrame:
    """Half of the blocks, others in every frame."""
    frame = frames(k)
    height, width = frame.depth_m.shape
    is_kept = np.random.default_rng(k).random(BLOCKS) < 0.5
    rows, columns = np.arange(height) * BLOCKS[0] // height, np.arange(width) * BLOCKS[1] // width
    return replace(frame, depth_m=frame.depth_m * is_kept[rows][:, columns])


def without_depth_on_the_left(frames: Frames, k: int) -> RgbdFrame:
    frame = frames(k)
    depth_m = frame.depth_m.copy()
    depth_m[:, : depth_m.shape[1] // 2] = 0
    return replace(frame, depth_m=depth_m)


def amplified(gain: float, frames: Frames, k: int) -> RgbdFrame:
    """Another exposure; what is too bright is white."""
    frame = frames(k)
    color = np.minimum(np.rint(gain * frame.color.astype(np.float32)), 255).astype(np.uint8)
    return replace(frame, color=color)


def frozen(start: int, frames: Frames, k: int) -> RgbdFrame:
    """The frame before `start` again; its index says what is shown."""
    return replace(frames(start - 1), stamp_ns=frames(k).stamp_ns)


def with_late_color(frames: Frames, k: int) -> RgbdFrame:
    return replace(frames(k), color=frames(k - 1).color)


def with_impossible_depth(frames: Frames, k: int) -> RgbdFrame:
    """A third of the pixels is NaN, infinite or negative, as some drivers send it."""
    frame, rng = frames(k), np.random.default_rng(k)
    is_bad = rng.random(frame.depth_m.shape) < 1 / 3
    bad = rng.choice(np.array([np.nan, np.inf, -np.inf, -1.0], np.float32), is_bad.sum())
    depth = frame.depth_m.copy()
    depth[is_bad] = bad
    raw = RawFrame(frame.index, frame.stamp_ns, frame.color, depth, 1.0, frame.camera)
    return rectify(raw, None)


def troubles(start: int, lasting: int = 60) -> dict[str, tuple[Degrader, range]]:
    """Every trouble by its name, with the frames that it lasts from `start` on."""
    return {
        "5 frames dropped": (dropped, range(start, start + 5)),
        "20 frames covered": (covered, range(start, start + 20)),
        "half of depth missing, in blocks": (
            without_depth_in_blocks,
            range(start, start + lasting),
        ),
        "left half without depth": (without_depth_on_the_left, range(start, start + lasting)),
        "twice as bright": (partial(amplified, 2.0), range(start, start + lasting)),
        "half as bright": (partial(amplified, 0.5), range(start, start + lasting)),
        "one frame repeated": (partial(frozen, start), range(start, start + 1)),
        "frozen for 10 frames": (partial(frozen, start), range(start, start + 10)),
        "colour one frame late": (with_late_color, range(start, start + lasting)),
        "impossible depth": (with_impossible_depth, range(start, start + lasting)),
    }


def shown(frames: Frames, count: int, degrade: Degrader, trouble: range) -> Iterator[RgbdFrame]:
    for k in range(count):
        frame = degrade(frames, k) if k in trouble else frames(k)
        if frame is not None:
            yield frame


# --- what tracking makes of them ------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Outcome:
    """Of tracking through a trouble. Errors are those of OK frames alone.

    ok_percent        of the frames outside the trouble
    worst_m           how far a camera was from the truth, aligned as without the trouble
    ate_m             RMSE after alignment
    recovered_after   frames after the trouble until the first that is OK; None: never
    """

    ok_percent: float
    ok_percent_meanwhile: float | None  # None: nothing arrived
    worst_m: float
    worst_frame: int
    ate_m: float
    recovered_after: int | None

    def __str__(self) -> str:
        meanwhile = self.ok_percent_meanwhile
        return (
            f"{self.ok_percent:.1f} | {'-' if meanwhile is None else f'{meanwhile:.1f}'} | "
            f"{100 * self.worst_m:.1f} "
            f"({self.worst_frame}) | {100 * self.ate_m:.2f} | {self.recovered_after}"
        )


@dataclass(frozen=True, slots=True)
class Step:
    k: int  # when
    source: int  # which frame of the sequence was shown
    status: TrackingStatus
    T_odom_camera: np.ndarray


def follow(frames: Iterator[RgbdFrame], stamps_ns: np.ndarray) -> list[Step]:
    """Track as the service does."""
    odometry, steps = Odometry(), []
    for frame in frames:
        result = odometry.process(frame)
        k = int(np.searchsorted(stamps_ns, frame.stamp_ns))
        steps.append(Step(k, frame.index, result.status, result.T_odom_camera))
    return steps


def outcome(
    steps: list[Step], trouble: range, T_true: Mapping[int, np.ndarray], T_true_odom: np.ndarray
) -> Outcome:
    outside = [s for s in steps if s.k not in trouble]
    meanwhile = [s.status is TrackingStatus.OK for s in steps if s.k in trouble]
    p_odom, p_true, times = ok_positions(steps, T_true)
    errors_m = np.linalg.norm(se3.transform(T_true_odom, p_odom) - p_true, axis=1)
    residuals_m = np.linalg.norm(
        se3.transform(fit_rigid_transform(p_odom, p_true), p_odom) - p_true, axis=1
    )
    after = [s.k for s in outside if s.k >= trouble.stop and s.status is TrackingStatus.OK]
    worst = int(np.argmax(errors_m))
    return Outcome(
        100 * float(np.mean([s.status is TrackingStatus.OK for s in outside])),
        100 * float(np.mean(meanwhile)) if meanwhile else None,
        float(errors_m[worst]),
        times[worst],
        float(np.sqrt(np.mean(residuals_m**2))),
        after[0] - trouble.stop if after else None,
    )


def ok_positions(
    steps: list[Step], T_true: Mapping[int, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Estimated and true [M, 3] of the OK frames that have a true pose, and their times k."""
    judged = [s for s in steps if s.status is TrackingStatus.OK and s.source in T_true]
    p_odom = np.array([s.T_odom_camera[:3, 3] for s in judged])
    p_true = np.array([T_true[s.source][:3, 3] for s in judged])
    return p_odom, p_true, [s.k for s in judged]


def undisturbed(
    sequence: Sequence, count: int, T_true: Mapping[int, np.ndarray]
) -> tuple[Outcome, np.ndarray]:
    """Without any trouble, and T_true_odom of its alignment. Odometry starts at the same place
    with a trouble, so the same alignment shows what a trouble did, jumps included."""
    none = range(count // 3, count // 3)
    steps = follow(map(sequence.__getitem__, range(count)), sequence.stamps_ns)
    T_true_odom = fit_rigid_transform(*ok_positions(steps, T_true)[:2])
    return outcome(steps, none, T_true, T_true_odom), T_true_odom


def truth_by_frame(sequence: Sequence) -> dict[int, np.ndarray]:
    """T_world_camera of the frames that have a true pose."""
    truth = sequence.truth()
    assert truth is not None
    pairs = associate(sequence.stamps_ns * 1e-9, truth.stamps_s, TRUTH_WITHIN_S)
    return {int(i): truth.T_world_camera[j] for i, j in pairs}


def main() -> None:
    sequence = open_sequence(sys.argv[1])
    count = min(len(sequence), int(sys.argv[2]) if len(sys.argv) > 2 else 300)
    T_true = truth_by_frame(sequence)
    baseline, T_true_odom = undisturbed(sequence, count, T_true)
    print(f"{HEADER}\n| none | {baseline} |", flush=True)
    for name, (degrade, trouble) in troubles(count // 3).items():
        steps = follow(shown(sequence.__getitem__, count, degrade, trouble), sequence.stamps_ns)
        print(f"| {name} | {outcome(steps, trouble, T_true, T_true_odom)} |", flush=True)


if __name__ == "__main__":
    main()
