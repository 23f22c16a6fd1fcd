"""What keyframes were measured against, and where the renderer wants them."""

from collections.abc import Iterator, KeysView, Mapping
from typing import Any

import numpy as np

from ldo_service.conversions.poses import pose_to_message
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import KeyframePoses
from ldo_service.geometry.point_records import RecordTable
from ldo_service.schemas import Keyframe, KeyframeRefinement, MeasuredPose
from ldo_service.schemas.pose import Matrix6

UPPER = np.triu_indices(6)
LINK = np.dtype([("id", np.int64), ("reference", np.int64), ("information", np.float32, (21,))])


class RelativeMeasurements:
    """Beside the poses of keyframes: which of them were measured against which.

    Of the newest `recent` all; of older ones that against the reference, in 100 bytes: what else
    they were measured against, the optimizer gave up when it condensed them.
    """

    def __init__(self, poses: KeyframePoses, recent: int) -> None:
        self._poses, self._most_recent = poses, recent
        self._recent: dict[int, dict[int, Matrix6]] = {}  # by keyframe, then by what it is against
        self._older = RecordTable(LINK)
        self._refinements = 0  # sent
        self._unacknowledged: dict[int, int] = {}  # the refinement that no correction knows yet

    def add(self, message: Keyframe) -> None:
        links = {} if message.reference is None else {message.reference: message.information}
        links |= {pose.reference: pose.information for pose in message.window_measurements}
        if links:
            self._recent[message.keyframe] = links
        while len(self._recent) > self._most_recent:
            self._grow_old(next(iter(self._recent)))

    def _grow_old(self, keyframe: int) -> None:
        reference, information = next(iter(self._recent.pop(keyframe).items()))
        self._older.put(keyframe, reference, np.reshape(information, (6, 6))[UPPER])

    def refined(self, moved: Mapping[int, np.ndarray], stamp_ns: int) -> KeyframeRefinement | None:
        """Keyframes that the optimiser moved to T_map_keyframe, measured anew against all that they
        were measured against; and those that were measured against them, against where they are
        now."""
        for keyframe, T_map_keyframe in moved.items():
            self._poses.place(keyframe, T_map_keyframe)
        poses = tuple(
            self._measured(keyframe, reference, information)
            for keyframe, reference, information in self._between(moved)
            if reference in self._poses
        )
        if not poses:
            return None
        self._refinements += 1
        self._unacknowledged.update(dict.fromkeys(moved, self._refinements))
        return KeyframeRefinement(stamp_ns=stamp_ns, poses=poses, number=self._refinements)

    def _between(self, moved: Mapping[int, np.ndarray]) -> Iterator[tuple[int, int, Matrix6]]:
        """Links at whose ends one of these is, oldest first: keyframe, reference, information."""
        older, keyframes = self._older.all, list(moved)
        at_an_end = np.isin(older["id"], keyframes) | np.isin(older["reference"], keyframes)
        for keyframe, reference, upper in older[at_an_end]:
            yield int(keyframe), int(reference), _whole(upper)
        for keyframe, links in self._recent.items():
            for reference, information in links.items():
                if keyframe in moved or reference in moved:
                    yield keyframe, reference, information

    def _measured(self, keyframe: int, reference: int, information: Matrix6) -> MeasuredPose:
        """The loss tells no information: the tracker's stands."""
        T_reference_keyframe = se3.inverse(self._poses[reference]) @ self._poses[keyframe]
        return MeasuredPose(
            reference=reference,
            keyframe=keyframe,
            T_reference_keyframe=pose_to_message(T_reference_keyframe),
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
            "recent": [(k, list(links.items())) for k, links in self._recent.items()],
            "older": self._older.columns(),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        self._refinements = state["refinements"]
        self._unacknowledged = dict(state["unacknowledged"])
        self._recent = {
            k: {reference: tuple(information) for reference, information in links}
            for k, links in state["recent"]
        }
        self._older.restore(state["older"])


def _whole(upper: np.ndarray) -> Matrix6:
    matrix = np.zeros((6, 6))
    matrix[UPPER] = upper
    return tuple((matrix + np.triu(matrix, 1).T).ravel().tolist())
