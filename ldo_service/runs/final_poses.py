"""Final camera poses in the map, after corrections have moved the keyframes."""

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.geometry import se3
from ldo_service.geometry.se3 import interpolate


@dataclass(frozen=True, slots=True)
class FramePose:
    """Pose of a frame as it was tracked.

    Attributes:
        stamp_ns: Stamp of the frame.
        reference: Id of the reference keyframe, to which the frame was aligned; None if there was
            none.
        T_reference_camera: Camera pose in the reference keyframe, [4, 4].
        T_map_camera_online: Camera pose in the map as it was published during the run, [4, 4].
        submap: Submap of the frame.
    """

    stamp_ns: int
    reference: int | None
    T_reference_camera: np.ndarray
    T_map_camera_online: np.ndarray
    submap: int


@dataclass(frozen=True, slots=True)
class MeasuredKeyframe:
    """Keyframe with its pose in the reference keyframe to which it was aligned."""

    stamp_ns: int
    keyframe: int
    T_reference_keyframe: np.ndarray


class FinalPoses:
    """Final poses T_map_camera of frames, computed from the final poses of keyframes.

    Each frame was aligned to a reference keyframe r. Consider r and the keyframes that were aligned
    to r. Keyframe a is the last of these that is not later than the frame, and keyframe b is the
    first one that is later. T_r_camera, T_r_a and T_r_b are the poses of the frame, of a and of b
    in r, measured during the run. T_map_a and T_map_b are final poses. Both keyframes give a pose
    of the camera:

        T_a = T_map_a T_r_a^-1 T_r_camera,    T_b = T_map_b T_r_b^-1 T_r_camera.

    Both poses are equal if no correction has moved a relative to b. Otherwise the result is
    interpolated between T_a and T_b, by the time of the frame between a and b. If there is no b,
    the result is T_a.
    """

    def __init__(self) -> None:
        # Each keyframe, followed by all keyframes that were aligned to it, sorted by time.
        self._measured: dict[int, list[MeasuredKeyframe]] = {}

    def add(self, measured: MeasuredKeyframe, reference: int | None) -> None:
        """Add a keyframe. Keyframes must be added in order of time.

        Args:
            measured: The keyframe.
            reference: Id of the keyframe to which `measured` was aligned; None if there was none.
        """
        itself = MeasuredKeyframe(measured.stamp_ns, measured.keyframe, np.eye(4))
        self._measured[measured.keyframe] = [itself]
        if reference in self._measured:
            self._measured[reference].append(measured)

    def of(self, frames: Sequence[FramePose], T_map: Mapping[int, np.ndarray]) -> np.ndarray:
        """Return the final poses of frames.

        Args:
            frames: The frames.
            T_map: Final pose T_map_keyframe of each keyframe, [4, 4], by id.

        Returns:
            T_map_camera, [N, 4, 4]. A frame without a known reference keyframe keeps the pose that
            was published during the run.
        """
        before, after, shares = [], [], []
        for frame in frames:
            a, b, share = self._around(frame)
            before.append(self._seen_from(a, frame, T_map))
            after.append(self._seen_from(b, frame, T_map))
            shares.append(share)
        T_a, T_b = (np.array(T).reshape(-1, 4, 4) for T in (before, after))
        return interpolate(T_a, T_b, np.array(shares, float))

    def _around(
        self, frame: FramePose
    ) -> tuple[MeasuredKeyframe | None, MeasuredKeyframe | None, float]:
        """Return the keyframes a and b of a frame, and the time of the frame between them, 0..1.

        Both keyframes are None if the reference of the frame is unknown. If there is no b, a is
        returned twice.
        """
        measured = self._measured.get(frame.reference, []) if frame.reference is not None else []
        if not measured:
            return None, None, 0.0
        place = bisect_right(measured, frame.stamp_ns, key=lambda m: m.stamp_ns)
        a = measured[max(place - 1, 0)]
        if place in (0, len(measured)):
            return a, a, 0.0
        b = measured[place]
        return a, b, (frame.stamp_ns - a.stamp_ns) / (b.stamp_ns - a.stamp_ns)

    @staticmethod
    def _seen_from(
        keyframe: MeasuredKeyframe | None, frame: FramePose, T_map: Mapping[int, np.ndarray]
    ) -> np.ndarray:
        if keyframe is None:
            return frame.T_map_camera_online
        T_keyframe_camera = se3.inverse(keyframe.T_reference_keyframe) @ frame.T_reference_camera
        return T_map[keyframe.keyframe] @ T_keyframe_camera
