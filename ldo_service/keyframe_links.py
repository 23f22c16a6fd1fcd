"""What keyframes were measured against, and where the renderer wants them."""

from collections.abc import KeysView, Mapping
from typing import Any

import numpy as np

from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import KeyframePoses
from ldo_service.schemas import Keyframe, KeyframeRefinement, MeasuredPose
from ldo_service.schemas.pose import Matrix6
from ldo_service.wire import pose_message


class KeyframeLinks:
    """Beside the poses of keyframes: which of them were measured against which."""

    def __init__(self, poses: KeyframePoses) -> None:
        self._poses = poses
        self._information: dict[tuple[int, int], Matrix6] = {}  # by keyframe and reference
        self._refinements = 0  # sent
        self._unacknowledged: dict[int, int] = {}  # the refinement that no correction knows yet

    def add(self, message: Keyframe) -> None:
        if message.reference is not None:
            self._information[message.keyframe, message.reference] = message.information
        for pose in message.window:
            self._information[pose.keyframe, pose.reference] = pose.information

    def refined(self, moved: Mapping[int, np.ndarray], stamp_ns: int) -> KeyframeRefinement | None:
        """Keyframes that the optimiser moved to T_map_keyframe, measured anew against all that they
        were measured against; and those that were measured against them, against where they are
        now."""
        for keyframe, T_map_keyframe in moved.items():
            self._poses.place(keyframe, T_map_keyframe)
        poses = tuple(
            self._measured(keyframe, reference, information)
            for (keyframe, reference), information in self._information.items()
            if reference in self._poses and (keyframe in moved or reference in moved)
        )
        if not poses:
            return None
        self._refinements += 1
        self._unacknowledged.update(dict.fromkeys(moved, self._refinements))
        return KeyframeRefinement(stamp_ns=stamp_ns, poses=poses, number=self._refinements)

    def _measured(self, keyframe: int, reference: int, information: Matrix6) -> MeasuredPose:
        """The loss tells no information: the tracker's stands."""
        T_reference_keyframe = se3.inverse(self._poses[reference]) @ self._poses[keyframe]
        return MeasuredPose(
            reference=reference,
            keyframe=keyframe,
            T_reference_keyframe=pose_message(T_reference_keyframe),
            information=information,
        )

    def acknowledged(self, refinements: int) -> KeysView[int]:
        """A correction knows so many: keyframes that it says nothing new of."""
        self._unacknowledged = {
            k: number for k, number in self._unacknowledged.items() if number > refinements
        }
        return self._unacknowledged.keys()

    def snapshot(self) -> dict[str, Any]:
        return {
            "refinements": self._refinements,
            "unacknowledged": list(self._unacknowledged.items()),
            "links": [(*pair, information) for pair, information in self._information.items()],
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        self._refinements = state["refinements"]
        self._unacknowledged = dict(state["unacknowledged"])
        self._information = {(k, reference): tuple(info) for k, reference, info in state["links"]}
