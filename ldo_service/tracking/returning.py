"""Tracking against known keyframes again, where the map has some. `ldo_service.geometry`.

A camera that makes keyframes wherever it goes fills a map with time, not with rooms: a robot on
its round would make the same ones every day. So once a map has many, a frame that is worth mapping
looks first for a known keyframe that shows the same, and new ones are made where there is none. A
known one counts only where the map already has the camera where the images put it: what has drifted
must be mapped on, so that a loop can be closed and the map be mended. A camera that comes from what
it has just mapped makes one keyframe more, measured from the known one: so the graph knows too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import RelativePose

from .align import AlignConfig
from .candidates import Candidate, apart_rad, attempt
from .judgement import History, JudgementConfig, Status, judge
from .keyframes import Keyframe, KeyframeConfig, has_left, shares_of_limits
from .places import Place
from .pyramid import Pyramid, PyramidConfig

Nearby = tuple[Place, np.ndarray]  # a place, and T_place_camera [4, 4] as the map has it


@dataclass(frozen=True, slots=True)
class ReturnConfig:
    after: int = 1500  # keyframes, supporting ones too: from then on known ones are looked for; 0:
    # never. Until then the map gains more by new views than they take, a few kB each
    tries: int = 2  # places per frame, the nearest first: 8 ms each at 640x480
    agreement_rad: float = 0.03  # rotation plus parallax between map and images, 3 % of the median
    # depth; above, keyframes are made until a loop is closed
    min_geometric_inliers: float = 0.85  # of the depths that meet a surface, as when relocalised

    def __post_init__(self) -> None:
        if self.after < 0 or self.tries < 1:
            raise ConfigError(f"{self}: after must be at least 0, tries at least 1.")
        if not (self.agreement_rad > 0 and 0 <= self.min_geometric_inliers <= 1):
            raise ConfigError(
                f"{self}: agreement_rad must be positive, min_geometric_inliers within 0..1."
            )


@dataclass(frozen=True, eq=False, slots=True)
class SeenAgain:
    """A place, the keyframe that it was, and the alignment of a view to that."""

    place: Place
    keyframe: Keyframe
    candidate: Candidate

    def measures(self, keyframe: int) -> RelativePose:
        """The pose of the keyframe that the view was made."""
        seen = self.candidate.alignment
        return RelativePose(self.place.id, keyframe, seen.T_reference_camera, seen.information)


@dataclass(frozen=True, slots=True)
class Returning:
    """How a known keyframe is found to go on against; knows nothing from frame to frame."""

    pyramid: PyramidConfig
    align: AlignConfig
    keyframes: KeyframeConfig
    judgement: JudgementConfig
    config: ReturnConfig

    def find(self, view: Pyramid, near: Sequence[Nearby], history: History) -> SeenAgain | None:
        """The first that a view surely shows, from where the map has the camera, and has not left.

        history  noise of the frames before: the next ones are judged by it too
        """
        for place, T_place_camera in near[: self.config.tries]:
            keyframe = place.keyframe(self.pyramid)
            candidate = attempt(keyframe, view, T_place_camera, "returned", self.align)
            histories = history, place.history(history)
            if self._is_sure(candidate, T_place_camera, histories):
                return SeenAgain(place, keyframe, candidate)
        return None

    def _is_sure(
        self, candidate: Candidate, T_place_camera: np.ndarray, histories: Sequence[History]
    ) -> bool:
        seen, T = candidate.alignment, candidate.alignment.T_reference_camera
        agrees = apart_rad(candidate, T_place_camera) < self.config.agreement_rad
        witnessed = replace(candidate, second_agrees=agrees)
        return (
            not has_left(T, seen.overlap, candidate.median_depth_m, self.keyframes)
            and seen.geometric_inliers >= self.config.min_geometric_inliers
            and all(
                judge(witnessed, history, Status.OK, self.judgement) is Status.OK
                for history in histories
            )
        )


def nearby(
    places: Sequence[Place],
    T_map_keyframe: Mapping[int, np.ndarray],
    T_map_camera: np.ndarray,
    config: KeyframeConfig,
) -> list[Nearby]:
    """The places that a camera at T_map_camera [4, 4] has not left, the nearest first.

    T_map_keyframe  [4, 4] by id; places that the map does not have are left out
    """
    known = [place for place in places if place.id in T_map_keyframe]
    if not known:
        return []
    T_camera = se3.inverse(np.array([T_map_keyframe[p.id] for p in known])) @ T_map_camera
    left = shares_of_limits(T_camera, np.array([place.median_depth_m for place in known]), config)
    order = np.argsort(left, kind="stable")
    return [(known[k], T_camera[k]) for k in order if left[k] <= 1]
