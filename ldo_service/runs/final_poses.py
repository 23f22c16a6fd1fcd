"""Where frames are in the map in the end, when keyframes have moved since."""

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.geometry import se3
from ldo_service.geometry.se3 import interpolate


@dataclass(frozen=True, slots=True)
class FramePose:
    """What the final trajectory needs of a frame."""

    stamp_ns: int
    reference: int | None
    T_reference_camera: np.ndarray
    T_map_camera_online: np.ndarray
    submap: int


@dataclass(frozen=True, slots=True)
class MeasuredKeyframe:
    """A keyframe, itself a frame that was tracked against a reference: T_reference_keyframe."""

    stamp_ns: int
    keyframe: int
    T_reference_keyframe: np.ndarray


class FinalPoses:
    """T_map_camera of frames, from T_map_keyframe of the keyframes around each.

    A frame at time t was measured in keyframe r, and so were the keyframes a before it and b after
    it. Each says where the frame is,

        T_a = T_map_a T_r_a^-1 T_r_camera,    T_b = T_map_b T_r_b^-1 T_r_camera,

    and as long as nothing was corrected they agree. What corrections changed between a and b is
    spread evenly over the time between them. a may be r; where there is no b, a alone says it.
    """

    def __init__(self) -> None:
        self._measured: dict[int, list[MeasuredKeyframe]] = {}  # by reference, ascending

    def add(self, measured: MeasuredKeyframe, reference: int | None) -> None:
        """A keyframe, later than all before."""
        itself = MeasuredKeyframe(measured.stamp_ns, measured.keyframe, np.eye(4))
        self._measured[measured.keyframe] = [itself]
        if reference in self._measured:
            self._measured[reference].append(measured)

    def of(self, frames: Sequence[FramePose], T_map: Mapping[int, np.ndarray]) -> np.ndarray:
        """T_map_camera [N, 4, 4]; as published where a frame had no reference that is known."""
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
        """The keyframes before and after, and how far from one to the other it is."""
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
