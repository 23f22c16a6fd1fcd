"""Final poses: corrections of keyframes, interpolated for the frames between them."""

import numpy as np

from ldo_service.geometry import se3
from ldo_service.runs.final_poses import FinalPoses, FramePose, MeasuredKeyframe

SECOND = 10**9
T_STEP = se3.exp(np.array([0, 0.05, 0, 0.02, 0, 0.1]))  # Motion in one second.


def at(seconds: float) -> np.ndarray:
    """Return the tracked T_odom_camera."""
    return se3.exp(seconds * se3.log(T_STEP))


def frame(seconds: float, reference: int | None) -> FramePose:
    """Return a tracked frame relative to a keyframe; keyframe k was made at second k."""
    T_reference_camera = se3.inverse(at(reference or 0)) @ at(seconds)
    return FramePose(int(seconds * SECOND), reference, T_reference_camera, at(seconds), 0)


def final(*references: int | None) -> FinalPoses:
    """Return final poses of one keyframe per second, measured against the given references."""
    poses = FinalPoses()
    for k, reference in enumerate(references):
        T = se3.inverse(at(reference or 0)) @ at(k)
        poses.add(MeasuredKeyframe(k * SECOND, k, T), reference)
    return poses


def test_without_corrections_frames_stay_where_they_were_tracked() -> None:
    poses = final(None, 0, 1, 1)
    frames = [frame(t, r) for t, r in ((0, 0), (0.4, 0), (1, 0), (1.5, 1), (2.5, 1), (3.5, 3))]
    T_map = {k: at(k) for k in range(4)}
    np.testing.assert_allclose(
        poses.of(frames, T_map), [f.T_map_camera_online for f in frames], atol=1e-12
    )


def test_correction_is_interpolated_between_keyframes() -> None:
    poses = final(None, 0, 0)
    T_new = se3.exp(np.array([0, 0, 0, 0, 0.3, 0]))
    T_map = {0: at(0), 1: T_new @ at(1), 2: T_new @ at(2)}
    times = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 2.9)
    moved = poses.of([frame(t, 0) for t in times], T_map)
    rise_m = [T[1, 3] - at(t)[1, 3] for T, t in zip(moved, times, strict=True)]
    np.testing.assert_allclose(rise_m, [0, 0.075, 0.15, 0.225, 0.3, 0.3, 0.3, 0.3], atol=1e-9)


def test_frame_of_a_keyframe_has_the_keyframe_pose() -> None:
    poses = final(None, 0, 1)
    T_map = {k: at(k) @ se3.exp(np.full(6, 0.02 * k)) for k in range(3)}
    np.testing.assert_allclose(poses.of([frame(2, 1)], T_map), [T_map[2]], atol=1e-12)


def test_a_frame_without_a_reference_stays_as_it_was_published() -> None:
    lost, unknown = frame(0.5, None), frame(0.5, 9)
    published = [lost.T_map_camera_online, unknown.T_map_camera_online]
    np.testing.assert_array_equal(final(None).of([lost, unknown], {0: at(0)}), published)


def test_no_frames_give_no_poses() -> None:
    assert FinalPoses().of([], {}).shape == (0, 4, 4)
