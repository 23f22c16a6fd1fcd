"""Degraded camera frames, and tracking through them.

    python -m tests.tracking.image_degradation SOURCE [FRAMES]    prints a table of them all

A `Degrader` is a pure function that returns the frame that replaces frame k.
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
Degrader = Callable[[Frames, int], RgbdFrame | None]  # Gives None if no frame arrives.

BLOCKS = (6, 8)  # Rows and columns of the blocks of depth.
TRUTH_WITHIN_S = 0.020
HEADER = """\
| degradation | OK % | OK % during | worst cm (frame) | ATE cm | OK again after |
|---|---|---|---|---|---|"""


# --- degraders ------------------------------------------------------------------------------------
def dropped(_frames: Frames, _k: int) -> None:
    return None


def covered(frames: Frames, k: int) -> RgbdFrame:
    """Return a black frame without depth, as with a hand over the lens."""
    frame = frames(k)
    return replace(frame, color=np.zeros_like(frame.color), depth_m=np.zeros_like(frame.depth_m))


def without_depth_in_blocks(frames: Frames, k: int) -> RgbdFrame:
    """Remove the depth of about half of the blocks; each frame has other blocks."""
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
    """Scale the brightness as another exposure would; bright pixels clip at white."""
    frame = frames(k)
    color = np.minimum(np.rint(gain * frame.color.astype(np.float32)), 255).astype(np.uint8)
    return replace(frame, color=color)


def frozen(start: int, frames: Frames, k: int) -> RgbdFrame:
    """Return the frame before `start` with the stamp of frame k; its index is not changed."""
    return replace(frames(start - 1), stamp_ns=frames(k).stamp_ns)


def with_late_color(frames: Frames, k: int) -> RgbdFrame:
    return replace(frames(k), color=frames(k - 1).color)


def with_impossible_depth(frames: Frames, k: int) -> RgbdFrame:
    """Set a third of the depth to NaN, infinity or -1, as some drivers send it."""
    frame, rng = frames(k), np.random.default_rng(k)
    is_bad = rng.random(frame.depth_m.shape) < 1 / 3
    bad = rng.choice(np.array([np.nan, np.inf, -np.inf, -1.0], np.float32), is_bad.sum())
    depth = frame.depth_m.copy()
    depth[is_bad] = bad
    raw = RawFrame(frame.index, frame.stamp_ns, frame.color, depth, 1.0, frame.camera)
    return rectify(raw, None)


def degradations(start: int, duration: int = 60) -> dict[str, tuple[Degrader, range]]:
    """Return each degradation by name, with the frames that it covers from `start` on."""
    return {
        "5 frames dropped": (dropped, range(start, start + 5)),
        "20 frames covered": (covered, range(start, start + 20)),
        "half of depth missing, in blocks": (
            without_depth_in_blocks,
            range(start, start + duration),
        ),
        "left half without depth": (without_depth_on_the_left, range(start, start + duration)),
        "twice as bright": (partial(amplified, 2.0), range(start, start + duration)),
        "half as bright": (partial(amplified, 0.5), range(start, start + duration)),
        "one frame repeated": (partial(frozen, start), range(start, start + 1)),
        "frozen for 10 frames": (partial(frozen, start), range(start, start + 10)),
        "color one frame late": (with_late_color, range(start, start + duration)),
        "impossible depth": (with_impossible_depth, range(start, start + duration)),
    }


def degraded_frames(
    frames: Frames, count: int, degrade: Degrader, degraded: range
) -> Iterator[RgbdFrame]:
    for k in range(count):
        frame = degrade(frames, k) if k in degraded else frames(k)
        if frame is not None:
            yield frame


# --- tracking -------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of tracking through a degradation. Errors are those of OK frames only.

    Attributes:
        ok_percent: Fraction of OK frames outside the degradation, percent.
        ok_percent_meanwhile: The same during the degradation; None if no frame arrived.
        max_m: Largest position error, with the alignment fitted without the degradation.
        worst_frame: Time index of the largest error.
        ate_m: RMSE after alignment.
        recovered_after: Frames from the end of the degradation to the first OK frame, if any.
    """

    ok_percent: float
    ok_percent_meanwhile: float | None
    max_m: float
    worst_frame: int
    ate_m: float
    recovered_after: int | None

    def __str__(self) -> str:
        meanwhile = self.ok_percent_meanwhile
        return (
            f"{self.ok_percent:.1f} | {'-' if meanwhile is None else f'{meanwhile:.1f}'} | "
            f"{100 * self.max_m:.1f} "
            f"({self.worst_frame}) | {100 * self.ate_m:.2f} | {self.recovered_after}"
        )


@dataclass(frozen=True, slots=True)
class Step:
    k: int  # Time index.
    source: int  # Index of the frame of the sequence that was shown.
    is_ok: bool
    T_odom_camera: np.ndarray


def track(frames: Iterator[RgbdFrame], stamps_ns: np.ndarray) -> list[Step]:
    """Track the frames as the service does.

    A frame of a new submap is not OK, since its pose relative to the first submap is unknown.
    """
    odometry, steps = Odometry(), []
    for frame in frames:
        result = odometry.process(frame)
        k = int(np.searchsorted(stamps_ns, frame.stamp_ns))
        is_ok = result.status is TrackingStatus.OK and result.submap == 0
        steps.append(Step(k, frame.index, is_ok, result.T_odom_camera))
    return steps


def outcome(
    steps: list[Step], degraded: range, T_true: Mapping[int, np.ndarray], T_true_odom: np.ndarray
) -> Outcome:
    """Return the OK fractions and the errors of tracked steps."""
    outside = [s for s in steps if s.k not in degraded]
    meanwhile = [s.is_ok for s in steps if s.k in degraded]
    p_odom, p_true, times = ok_positions(steps, T_true)
    errors_m = np.linalg.norm(se3.transform(T_true_odom, p_odom) - p_true, axis=1)
    residuals_m = np.linalg.norm(
        se3.transform(fit_rigid_transform(p_odom, p_true), p_odom) - p_true, axis=1
    )
    after = [s.k for s in outside if s.k >= degraded.stop and s.is_ok]
    worst = int(np.argmax(errors_m))
    return Outcome(
        100 * float(np.mean([s.is_ok for s in outside])),
        100 * float(np.mean(meanwhile)) if meanwhile else None,
        float(errors_m[worst]),
        times[worst],
        float(np.sqrt(np.mean(residuals_m**2))),
        after[0] - degraded.stop if after else None,
    )


def ok_positions(
    steps: list[Step], T_true: Mapping[int, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Return estimated and true positions [M, 3] and the indices of OK frames with ground truth."""
    evaluated = [s for s in steps if s.is_ok and s.source in T_true]
    p_odom = np.array([s.T_odom_camera[:3, 3] for s in evaluated])
    p_true = np.array([T_true[s.source][:3, 3] for s in evaluated])
    return p_odom, p_true, [s.k for s in evaluated]


def track_undisturbed(
    sequence: Sequence, count: int, T_true: Mapping[int, np.ndarray]
) -> tuple[Outcome, np.ndarray]:
    """Track without a degradation; return the outcome and its alignment T_true_odom.

    A track with a degradation starts at the same pose, so this alignment also fits it. Its errors
    then show what the degradation changed, jumps included.
    """
    no_frames = range(count // 3, count // 3)
    steps = track(map(sequence.__getitem__, range(count)), sequence.stamps_ns)
    T_true_odom = fit_rigid_transform(*ok_positions(steps, T_true)[:2])
    return outcome(steps, no_frames, T_true, T_true_odom), T_true_odom


def truth_by_frame(sequence: Sequence) -> dict[int, np.ndarray]:
    """Return T_world_camera of the frames that have a ground-truth pose."""
    truth = sequence.truth()
    assert truth is not None
    pairs = associate(sequence.stamps_ns * 1e-9, truth.stamps_s, TRUTH_WITHIN_S)
    return {int(i): truth.T_world_camera[j] for i, j in pairs}


def main() -> None:
    sequence = open_sequence(sys.argv[1])
    count = min(len(sequence), int(sys.argv[2]) if len(sys.argv) > 2 else 300)
    T_true = truth_by_frame(sequence)
    baseline, T_true_odom = track_undisturbed(sequence, count, T_true)
    print(f"{HEADER}\n| none | {baseline} |", flush=True)
    for name, (degrade, degraded) in degradations(count // 3).items():
        steps = track(
            degraded_frames(sequence.__getitem__, count, degrade, degraded), sequence.stamps_ns
        )
        print(f"| {name} | {outcome(steps, degraded, T_true, T_true_odom)} |", flush=True)


if __name__ == "__main__":
    main()
