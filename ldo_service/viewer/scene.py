"""The map and the camera as a scene, and its Gaussians as a browser draws them.

Conventions: `ldo_service.geometry`.
"""

from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from ldo_service.gaussians.model import ROW
from ldo_service.gaussians.pruning import _opacities
from ldo_service.geometry import Camera, se3
from ldo_service.schemas import MapObjects
from ldo_service.schemas.objects import Box

NOTHING = np.zeros((0, 3))


Layer = Literal["gaussians", "camera", "online", "final", "keyframes", "objects", "loops", "facts"]


@dataclass(frozen=True, slots=True)
class ObjectBox:
    """What a keyframe shows: a name, and its box in the image in pixels."""

    name: str
    box_px: Box


@dataclass(slots=True)
class Scene:
    """All in the map frame, metres. What other threads read, `keyframes` and `objects`, is replaced
    and never written to."""

    # [N, 16], see `gaussians.model`; valid until the next update
    rows: np.ndarray = field(default_factory=lambda: np.zeros((0, ROW), np.float32))
    online: np.ndarray = field(default_factory=NOTHING.copy)  # [K, 3] camera, as it was published
    final: np.ndarray = field(default_factory=NOTHING.copy)  # [K, 3] after the last correction
    keyframes: dict[int, np.ndarray] = field(default_factory=dict)  # T_map_camera [4, 4] by id
    camera: Camera | None = None  # of the keyframes, rectified; None where it is not known yet
    sights: dict[int, tuple[ObjectBox, ...]] = field(default_factory=dict)  # by keyframe
    objects: MapObjects | None = None
    loops: tuple[tuple[int, int], ...] = ()  # pairs of keyframes
    T_map_camera: np.ndarray | None = None  # [4, 4] where the camera is, or was at the end
    facts: str = ""  # Markdown


class Source(Protocol):
    """Where a scene comes from."""

    @property
    def scene(self) -> Scene: ...

    def update(self, *, is_watched: bool = True) -> set[Layer]:
        """Take what is new; says what changed. Where nobody watches that waits."""
        ...


def sights_of(objects: MapObjects) -> dict[int, tuple[ObjectBox, ...]]:
    """Those that it names as the views of its objects, by keyframe."""
    sights: dict[int, tuple[ObjectBox, ...]] = {}
    for one in objects.objects:
        for view in one.views:
            others = sights.get(view.keyframe, ())
            sights[view.keyframe] = (*others, ObjectBox(one.name, view.box_px))
    return sights


def thinned(values: np.ndarray, most: int) -> np.ndarray:
    """At most so many of `values` [K, ...], evenly chosen, the first among them."""
    return values[:: max(1, -(-len(values) // most))]


@dataclass(frozen=True, slots=True)
class Splats:
    """centers      [N, 3] float32, metres, map frame
    covariances  [N, 3, 3] float32, m^2
    colors       [N, 3] float32 RGB, 0..1
    opacities    [N, 1] float32, 0..1
    """

    centers: np.ndarray
    covariances: np.ndarray
    colors: np.ndarray
    opacities: np.ndarray


def splats_of(rows: np.ndarray) -> Splats:
    """Of Gaussian rows [N, 16] (see `gaussians.model`): the covariance is R S S R^T, with the
    rotation R of the quaternion and the scales S."""
    R, scales = se3.rotation(rows[:, 6:10]), np.exp(rows[:, 3:6])
    half = R * scales[:, None, :]  # R S
    return Splats(
        rows[:, 0:3],
        half @ half.transpose(0, 2, 1),
        np.clip(rows[:, 11:14], 0, 1),
        _opacities(rows)[:, None],
    )
