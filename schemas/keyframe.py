"""Keyframes, as the tracker makes them and the mapper places them better."""

import msgspec
import numpy as np

from ldo_service.schemas.array import Array
from ldo_service.schemas.frames import CameraModel, require_rgbd
from ldo_service.schemas.message import Message, require_count, require_finite
from ldo_service.schemas.pose import Matrix6, Pose, require_matrix6

NO_MASK = Array.of(np.zeros((0, 0), np.uint8))


class MeasuredPose(msgspec.Struct, frozen=True, kw_only=True):
    """A measured pose of one keyframe in another."""

    reference: int
    keyframe: int
    T_reference_keyframe: Pose
    information: Matrix6  # perturbed on the right

    def __post_init__(self) -> None:
        require_count("reference", self.reference)
        require_count("keyframe", self.keyframe)
        require_matrix6("information", self.information)
        if self.reference == self.keyframe:
            raise ValueError(f"keyframe {self.keyframe} is measured against itself")


class Keyframe(Message, frozen=True, kw_only=True):
    """keyframe/new: a frame that the map is made from, placed relative to its reference keyframe.

    The optimizer alone owns poses in the map; a receiver chains this one to the pose it knows of
    `reference`. `T_odom_keyframe` lets a receiver that missed the reference chain to any other.
    The first of a submap has no reference: tracking was lost, and where it is, is not known.
    """

    keyframe: int  # id, ascending
    frame: int  # as in camera/rgbd
    camera: CameraModel  # without distortion
    color: Array  # u1 [H, W, 3] RGB
    depth_m: Array  # f4 [H, W], z in metres, 0 = not measured
    reference: int | None  # id of the reference keyframe; None for the first of a submap
    T_reference_keyframe: Pose
    information: Matrix6  # of T_reference_keyframe, perturbed on the right
    T_odom_keyframe: Pose
    overlap: float = 1.0  # share of the reference's surface that this keyframe sees
    # This keyframe measured from others than the reference.
    window_measurements: tuple[MeasuredPose, ...] = ()
    # u1 [H, W], 1: shows what moves and is not mapped; [0, 0]: nothing moves.
    dynamic_mask: Array = NO_MASK
    submap: int = 0  # which of the stretches without a loss it was made in
    # As window_measurements, in keyframes of submaps that this one joins.
    submap_measurements: tuple[MeasuredPose, ...] = ()

    def check(self) -> None:
        require_count("keyframe", self.keyframe)
        require_count("frame", self.frame)
        require_rgbd(self.camera, self.color, self.depth_m)
        require_matrix6("information", self.information)
        require_finite("overlap", (self.overlap,))
        require_count("submap", self.submap)
        if self.dynamic_mask.shape != (0, 0):
            self.dynamic_mask.require("dynamic_mask", "u1", (self.camera.height, self.camera.width))
        if any(pose.keyframe != self.keyframe for pose in self.submap_measurements):
            raise ValueError(f"a join of keyframe {self.keyframe} measures another keyframe")
        if self.reference is not None and not 0 <= self.reference < self.keyframe:
            raise ValueError(
                f"keyframe {self.keyframe} refers to {self.reference}, not an older one"
            )
        for pose in self.window_measurements:
            if not pose.reference < pose.keyframe == self.keyframe:
                raise ValueError(
                    f"keyframe {self.keyframe} comes with {pose.keyframe} from {pose.reference}"
                )


class KeyframeRefinement(Message, frozen=True, kw_only=True):
    """keyframe/refinement: measurements that replace earlier ones between the same keyframes."""

    poses: tuple[MeasuredPose, ...]
    number: int = 0  # ascending from 1; 0: not counted

    def check(self) -> None:
        require_count("number", self.number)
