"""Views of objects, and smooth motion of the viewer's virtual camera to these views."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from ldo_service.schemas import MapObject

FILLS = 0.4  # Size of an object as a fraction of the height of the picture.
NEAREST_M = 0.4  # Minimum distance to the center of an object.
TILT = 0.05  # Weight of the cameras' tilt in `estimate_up`; their roll has the weight 1.
HALF_VIEW_RAD = (
    0.65  # Half the vertical field of view of the browser, which is 75 degrees in viser.
)


@dataclass(frozen=True, slots=True)
class CameraView:
    """Position and viewing direction of the virtual camera in a browser.

    Attributes:
        position: Position of the camera in the map frame, [3], meters.
        look_at: Point of the map frame in the center of the picture, [3], meters.
    """

    position: np.ndarray
    look_at: np.ndarray


def view_of(one: MapObject, keyframes: Mapping[int, np.ndarray], eye: np.ndarray) -> CameraView:
    """Return a close view of a whole object, if possible from a direction that is not occluded.

    The view lies on the line from the object to the keyframe that shows the object best. Keyframes
    without a known pose are skipped. If no keyframe is left, `eye` replaces the keyframe.

    Args:
        one: The object.
        keyframes: T_map_camera of each keyframe, [4, 4], by id.
        eye: Current position of the browser's virtual camera in the map frame, [3], meters.
    """
    center = np.array(one.T_map_object.translation)
    known = [view.keyframe for view in one.views if view.keyframe in keyframes]
    seen_from = keyframes[known[0]][:3, 3] if known else eye
    away_m = float(np.linalg.norm(seen_from - center))
    toward = (seen_from - center) / away_m if away_m > 0 else np.array([0.0, 0.0, -1.0])
    radius_m = float(np.linalg.norm(one.size)) / 2
    whole_m = radius_m / (FILLS * np.tan(HALF_VIEW_RAD))
    distance_m = max(NEAREST_M, min(whole_m, away_m) if known else whole_m)
    return CameraView(center + distance_m * toward, center)


def overview(T_map_camera: np.ndarray, back_m: float = 0.6, ahead_m: float = 2.0) -> CameraView:
    """Return a view from behind a camera, in the viewing direction of that camera.

    Args:
        T_map_camera: Pose of the camera, [4, 4].
        back_m: Distance of the view behind the camera, meters.
        ahead_m: Distance from the camera to the point in the center of the picture, meters.
    """
    position, ahead = T_map_camera[:3, 3], T_map_camera[:3, 2]
    return CameraView(position - back_m * ahead, position + ahead_m * ahead)


def estimate_up(keyframes: Mapping[int, np.ndarray]) -> np.ndarray:
    """Estimate the up direction, a unit vector [3] in the map frame, for a level horizon.

    A handheld camera is tilted more than it is rolled. Let x (right) and y (down) be the axes of
    each keyframe's camera. The up direction is the unit vector u that minimizes

        mean (x . u)^2 + TILT (1 - mean (y . u)^2)

    over the keyframes, with the sign that makes it opposite to the mean y. If there are no
    keyframes, the result is -y of the map. This is correct if the camera was level at the start.

    Args:
        keyframes: T_map_camera of each keyframe, [4, 4], by id.
    """
    T = np.array([*keyframes.values()]).reshape(-1, 4, 4)
    if not len(T):
        return np.array([0.0, -1.0, 0.0])
    x, y = T[:, :3, 0], T[:, :3, 1]
    _, vectors = np.linalg.eigh((x.T @ x - TILT * y.T @ y) / len(T))
    up = vectors[:, 0]  # Eigenvector of the smallest eigenvalue.
    return up if y.mean(axis=0) @ up < 0 else -up


def interpolate_views(start: CameraView, end: CameraView, steps: int) -> Iterator[CameraView]:
    """Yield `steps` views of a motion from `start` to `end`; the motion is slow at both ends.

    The last view is `end`.
    """
    for step in range(1, steps + 1):
        t = step / steps
        share = t * t * (3 - 2 * t)
        yield CameraView(
            start.position + share * (end.position - start.position),
            start.look_at + share * (end.look_at - start.look_at),
        )
