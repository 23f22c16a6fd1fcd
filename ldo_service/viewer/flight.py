"""From where an object is best looked at, and how to get there."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from ldo_service.schemas import MapObject

FILLS = 0.4  # of the height of the picture, by the object
NEAREST_M = 0.4  # to its centre
TILT = 0.05  # what tilting a camera costs, rolling it costs 1
HALF_VIEW_RAD = 0.65  # half the height of the browser's picture: viser has 75 degrees


@dataclass(frozen=True, slots=True)
class CameraView:
    """position, look_at  [3] metres, map frame"""

    position: np.ndarray
    look_at: np.ndarray


def view_of(one: MapObject, keyframes: Mapping[int, np.ndarray], eye: np.ndarray) -> CameraView:
    """The object as it was seen from the keyframe that shows it best, so that nothing is between,
    and as near as shows the whole of it; from the side of `eye` [3] where no keyframe is known.

    keyframes  T_map_camera [4, 4] by id
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
    """From a little behind a camera [4, 4], in its direction."""
    position, ahead = T_map_camera[:3, 3], T_map_camera[:3, 2]
    return CameraView(position - back_m * ahead, position + ahead_m * ahead)


def estimate_up(keyframes: Mapping[int, np.ndarray]) -> np.ndarray:
    """Up [3] in the map, for a horizon that is level: a camera in a hand is tilted more than it is
    rolled. With x and y the axes of the cameras, to the right and down, it is the unit vector u
    with the least

        mean (x . u)^2 + TILT (1 - mean (y . u)^2)

    on the side of -y. Without keyframes it is what was up in the first one."""
    T = np.array([*keyframes.values()]).reshape(-1, 4, 4)
    if not len(T):
        return np.array([0.0, -1.0, 0.0])
    x, y = T[:, :3, 0], T[:, :3, 1]
    _, vectors = np.linalg.eigh((x.T @ x - TILT * y.T @ y) / len(T))
    up = vectors[:, 0]  # of the least eigenvalue
    return up if y.mean(axis=0) @ up < 0 else -up


def interpolate_views(start: CameraView, end: CameraView, steps: int) -> Iterator[CameraView]:
    """Views from one to the other, slow at both ends; the last is `end`."""
    for step in range(1, steps + 1):
        t = step / steps
        share = t * t * (3 - 2 * t)
        yield CameraView(
            start.position + share * (end.position - start.position),
            start.look_at + share * (end.look_at - start.look_at),
        )
