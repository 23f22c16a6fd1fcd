"""Scene that the viewer draws, and conversion of its Gaussians for the browser.

Conventions: `ldo_service.geometry`.
"""

from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from ldo_service.gaussians.pruning import _opacities
from ldo_service.gaussians.rows import ROW
from ldo_service.geometry import Camera, se3
from ldo_service.schemas import MapObjects
from ldo_service.schemas.objects import Box

NOTHING = np.zeros((0, 3))


Layer = Literal["gaussians", "camera", "online", "final", "keyframes", "objects", "loops", "facts"]


@dataclass(frozen=True, slots=True)
class ObjectBox:
    """Detection in a keyframe: a name and a box in the image, pixels."""

    name: str
    box_px: Box


@dataclass(slots=True)
class Scene:
    """Content of the window, in the map frame and in meters.

    Other threads read `keyframes` and `objects`. An update therefore replaces these two values and
    never modifies them.
    """

    # Gaussians, [N, 16], see `gaussians.rows`; valid until the next update.
    rows: np.ndarray = field(default_factory=lambda: np.zeros((0, ROW), np.float32))
    # Camera path as the tracker published it, [K, 3]; NaN where unknown.
    online: np.ndarray = field(default_factory=NOTHING.copy)
    # Camera path after the last correction of the pose graph, [K, 3].
    final: np.ndarray = field(default_factory=NOTHING.copy)
    keyframes: dict[int, np.ndarray] = field(default_factory=dict)  # T_map_camera, [4, 4], by id.
    camera: Camera | None = None  # Rectified camera of the keyframes; None until it is known.
    # Detections in each keyframe, drawn as boxes in the outline of its image, by keyframe id.
    detections: dict[int, tuple[ObjectBox, ...]] = field(default_factory=dict)
    objects: MapObjects | None = None
    loops: tuple[tuple[int, int], ...] = ()  # Ids of reference and keyframe of each loop closure.
    # Current pose of the camera, or the pose at the end of a run, [4, 4]; None until it is known.
    T_map_camera: np.ndarray | None = None
    facts: str = ""  # Text of the panel, Markdown.


class Source(Protocol):
    """Interface of a source that builds a scene and keeps it up to date."""

    @property
    def scene(self) -> Scene: ...

    def update(self, *, is_watched: bool = True) -> set[Layer]:
        """Bring the scene up to date.

        Args:
            is_watched: False if no browser is connected; work may then be postponed.

        Returns:
            The layers that have changed.
        """
        ...


def detections_of(objects: MapObjects) -> dict[int, tuple[ObjectBox, ...]]:
    """Return the detections of all objects, grouped by the id of the keyframe."""
    detections: dict[int, tuple[ObjectBox, ...]] = {}
    for one in objects.objects:
        for view in one.views:
            others = detections.get(view.keyframe, ())
            detections[view.keyframe] = (*others, ObjectBox(one.name, view.box_px))
    return detections


def thinned(values: np.ndarray, most: int) -> np.ndarray:
    """Return at most `most` of the values, evenly spaced, including the first.

    Args:
        values: Values, [K, ...].
        most: Maximum number of values.
    """
    return values[:: max(1, -(-len(values) // most))]


@dataclass(frozen=True, slots=True)
class Splats:
    """Gaussians in the format in which viser draws them.

    Attributes:
        centers: Centers in the map frame, [N, 3] float32, meters.
        covariances: Covariances, [N, 3, 3] float32, m^2.
        colors: RGB, [N, 3] float32, 0..1.
        opacities: Opacities, [N, 1] float32, 0..1.
    """

    centers: np.ndarray
    covariances: np.ndarray
    colors: np.ndarray
    opacities: np.ndarray


def splats_of(rows: np.ndarray) -> Splats:
    """Convert Gaussians to the format in which viser draws them.

    The covariance is R S S R^T, with the rotation matrix R of the quaternion and the diagonal
    matrix S of the scales.

    Args:
        rows: Gaussians, [N, 16], see `gaussians.rows`.
    """
    R, scales = se3.rotation(rows[:, 6:10]), np.exp(rows[:, 3:6])
    half = R * scales[:, None, :]  # Factor R S of the covariance.
    return Splats(
        rows[:, 0:3],
        half @ half.transpose(0, 2, 1),
        np.clip(rows[:, 11:14], 0, 1),
        _opacities(rows)[:, None],
    )
