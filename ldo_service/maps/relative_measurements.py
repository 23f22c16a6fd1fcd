"""Relative-pose measurements of keyframes, recomputed after the Gaussian optimizer moved poses."""

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
    """Table of the relative-pose measurements that tracking made, by pair of keyframes.

    All measurements of the newest `recent` keyframes are stored. For an older keyframe, only the
    measurement relative to its reference keyframe is stored, which takes 100 bytes. The pose-graph
    optimizer no longer uses the other measurements of an older keyframe.
    """

    def __init__(self, poses: KeyframePoses, recent: int) -> None:
        self._poses, self._most_recent = poses, recent
        # Information matrix by keyframe and by reference keyframe.
        self._recent: dict[int, dict[int, Matrix6]] = {}
        self._older = RecordTable(LINK)
        self._refinements = 0  # Number of published refinements.
        # Number of the last refinement of each keyframe that no pose correction includes yet.
        self._unacknowledged: dict[int, int] = {}

    def add(self, message: Keyframe) -> None:
        """Add the measurements of a new keyframe."""
        links = {} if message.reference is None else {message.reference: message.information}
        links |= {pose.reference: pose.information for pose in message.window_measurements}
        if links:
            self._recent[message.keyframe] = links
        while len(self._recent) > self._most_recent:
            self._reduce(next(iter(self._recent)))

    def _reduce(self, keyframe: int) -> None:
        reference, information = next(iter(self._recent.pop(keyframe).items()))
        self._older.put(keyframe, reference, np.reshape(information, (6, 6))[UPPER])

    def refined(self, moved: Mapping[int, np.ndarray], stamp_ns: int) -> KeyframeRefinement | None:
        """Recompute the measurements of keyframes that the Gaussian optimizer moved.

        A measurement is recomputed if at least one of its two keyframes moved.

        Args:
            moved: New poses T_map_keyframe [4, 4], by keyframe.
            stamp_ns: Stamp of the message.

        Returns:
            The message for the pose-graph optimizer, or None if no measurement was recomputed.
        """
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
        """Yield the measurements in which at least one keyframe moved, the oldest first.

        Yields:
            The measured keyframe, the keyframe that it was measured relative to, and the
            information matrix.
        """
        older, keyframes = self._older.all, list(moved)
        at_an_end = np.isin(older["id"], keyframes) | np.isin(older["reference"], keyframes)
        for keyframe, reference, upper in older[at_an_end]:
            yield int(keyframe), int(reference), _whole(upper)
        for keyframe, links in self._recent.items():
            for reference, information in links.items():
                if keyframe in moved or reference in moved:
                    yield keyframe, reference, information

    def _measured(self, keyframe: int, reference: int, information: Matrix6) -> MeasuredPose:
        """Return the relative pose of two keyframes at their current poses, as a measurement.

        The information matrix remains that of the tracker, since the optimization of the Gaussians
        gives no information matrix.
        """
        T_reference_keyframe = se3.inverse(self._poses[reference]) @ self._poses[keyframe]
        return MeasuredPose(
            reference=reference,
            keyframe=keyframe,
            T_reference_keyframe=pose_to_message(T_reference_keyframe),
            information=information,
        )

    def acknowledged(self, refinements: int) -> KeysView[int]:
        """Return the keyframes whose last refinement is missing from a pose correction.

        All other keyframes are deleted from the table of unacknowledged refinements.

        Args:
            refinements: Number of the last refinement message that the correction includes.
        """
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
