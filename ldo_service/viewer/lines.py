"""Line drawings of a scene: paths, keyframes, boxes, loop closures."""

import colorsys
import itertools
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ldo_service.conversions.poses import pose_from_message
from ldo_service.geometry import Camera, se3
from ldo_service.schemas import MapObject

from .scene import ObjectBox

Color = tuple[int, int, int]  # RGB, 0..255.

# A step between two poses is a jump if it reaches both limits below. Tracking was then lost between
# the two poses.
JUMP_M = 1.0  # Minimum length of a jump.
JUMPS = 10.0  # Minimum length of a jump as a multiple of the median step.
FRUSTUM_M = 0.12  # Distance from a keyframe's camera center to the drawn outline of its image.
MAX_DETECTIONS = 8  # Maximum number of detections drawn per keyframe; more would hide each other.
# Intrinsics for drawing keyframes until their own intrinsics are known.
UNKNOWN_CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)

ONLINE, FINAL = (220, 90, 0), (0, 150, 30)
KEYFRAME, LOOP, FOUND = (20, 70, 220), (220, 0, 110), (255, 255, 255)


@dataclass(frozen=True, slots=True)
class Lines:
    """Colored line segments.

    Attributes:
        points: Both ends of each segment in the map frame, [S, 2, 3] float32, meters.
        colors: RGB of both ends, [S, 2, 3] uint8.
    """

    points: np.ndarray
    colors: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, color: Color) -> "Lines":
        """Return segments of one color, given both ends of each segment, [S, 2, 3] meters."""
        points = np.asarray(points, np.float32).reshape(-1, 2, 3)
        return cls(points, np.broadcast_to(np.array(color, np.uint8), points.shape))

    @classmethod
    def together(cls, many: Iterable["Lines"]) -> "Lines":
        """Concatenate the segments of several `Lines`."""
        lines = [cls.of(np.zeros((0, 2, 3)), FOUND), *many]
        return cls(
            np.concatenate([one.points for one in lines]),
            np.concatenate([one.colors for one in lines]),
        )


def path_lines(positions: np.ndarray, color: Color) -> Lines:
    """Return the path through camera positions, with gaps where the position jumps.

    A step between two positions is a jump if it has at least the length JUMP_M, and at least JUMPS
    times the median length. A long path is drawn with only some of its positions, so its steps are
    longer. The median length adapts the limit to these longer steps.

    Args:
        positions: Positions of the camera, [K, 3], meters; NaN where unknown.
        color: Color of the path.
    """
    segments = np.stack([positions[:-1], positions[1:]], axis=1)
    steps_m = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    known_m = steps_m[np.isfinite(steps_m)]
    usual_m = float(np.median(known_m)) if len(known_m) else 0.0
    is_step = steps_m < max(JUMP_M, JUMPS * usual_m)
    return Lines.of(segments[is_step], color)


def keyframe_lines(
    keyframes: Iterable[np.ndarray], camera: Camera | None, color: Color = KEYFRAME
) -> Lines:
    """Return the view frustum of each camera: the image outline and the lines to its corners.

    Args:
        keyframes: T_map_camera of each camera, [4, 4].
        camera: Intrinsics; None uses UNKNOWN_CAMERA.
        color: Color of the lines.
    """
    camera = camera or UNKNOWN_CAMERA
    whole = np.array([[-0.5, -0.5, camera.width - 0.5, camera.height - 0.5]])
    (outline,) = _outlines(camera, whole)
    rays = np.stack([np.zeros((4, 3)), outline[:, 0]], axis=1)
    shape = np.concatenate([rays, outline])
    return Lines.of(np.array([se3.transform(T, shape) for T in keyframes]), color)


def detection_lines(
    keyframes: Mapping[int, np.ndarray],
    camera: Camera | None,
    detections: Mapping[int, Iterable[ObjectBox]],
) -> Lines:
    """Return the boxes of detections, drawn in the image outlines of their keyframes.

    Args:
        keyframes: T_map_camera of each keyframe, [4, 4], by id.
        camera: Intrinsics of the keyframes. If None, the result has no lines.
        detections: Detections of each keyframe, by keyframe id.
    """
    shown = [
        (T, detection)
        for keyframe, T in keyframes.items()
        for detection in itertools.islice(detections.get(keyframe, ()), MAX_DETECTIONS)
    ]
    if camera is None or not shown:
        return Lines.together(())
    T_map_camera = np.array([T for T, _ in shown])[:, None, None]  # [M, 1, 1, 4, 4]
    outlines = _outlines(camera, np.array([detection.box_px for _, detection in shown]))
    points = (T_map_camera[..., :3, :3] @ outlines[..., None])[..., 0] + T_map_camera[..., :3, 3]
    colors = np.array([color_of(detection.name) for _, detection in shown], np.uint8)
    return Lines(
        points.reshape(-1, 2, 3).astype(np.float32),
        np.broadcast_to(colors[:, None, None], outlines.shape).reshape(-1, 2, 3),
    )


def box_lines(objects: Iterable[MapObject], color: Color | None = None) -> Lines:
    """Return the edges of each object's box; by default, `color_of(name)` gives their color."""
    return Lines.together(
        Lines.of(
            se3.transform(pose_from_message(one.T_map_object), EDGES * one.size),
            color or color_of(one.name),
        )
        for one in objects
    )


def loop_lines(loops: Iterable[tuple[int, int]], keyframes: Mapping[int, np.ndarray]) -> Lines:
    """Return a line for each loop closure, if the poses of both keyframes are known.

    Args:
        loops: Ids of the two keyframes of each closure.
        keyframes: T_map_camera of each keyframe, [4, 4], by id.
    """
    ends = [
        [keyframes[a][:3, 3], keyframes[b][:3, 3]]
        for a, b in loops
        if a in keyframes and b in keyframes
    ]
    return Lines.of(np.array(ends), LOOP)


@lru_cache(maxsize=1024)
def color_of(name: str) -> Color:
    """Return the color of an object name.

    The color is saturated, because browsers draw thin lines in paler colors.
    """
    hue = zlib.crc32(name.encode()) % 360 / 360
    red, green, blue = (round(255 * value) for value in colorsys.hls_to_rgb(hue, 0.45, 1.0))
    return red, green, blue


def _outlines(camera: Camera, boxes_px: np.ndarray) -> np.ndarray:
    """Return the sides of image boxes as lines in space, at depth FRUSTUM_M.

    Args:
        camera: Intrinsics.
        boxes_px: Boxes in the image, [M, 4], pixels.

    Returns:
        Both ends of each side in the camera frame, [M, 4, 2, 3], meters.
    """
    corners_px = boxes_px[:, [[0, 1], [2, 1], [2, 3], [0, 3]]]  # [M, 4, 2]
    points = camera.points_at(corners_px[..., 0], corners_px[..., 1], FRUSTUM_M)
    return np.stack([points, np.roll(points, -1, axis=1)], axis=2)


def _edges() -> np.ndarray:
    """Return the edges of a box of side 1 around the origin, [12, 2, 3]."""
    corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    pairs = itertools.combinations(corners, 2)
    return np.array([pair for pair in pairs if np.abs(np.subtract(*pair)).sum() == 1])


EDGES = _edges()
