"""Finding a lost camera among all places. Conventions: `ldo_service.geometry`.

A lost frame is compared with the places whose thumbnails are most like it, and with a few more
in turn, so that each frame costs the same however large the memory is, and every place has its
chance. Where its fast features find nothing, SIFT looks at others in turn, and at the newest: it
knows a room again from twice as far, for ten times the price. A place counts as found when features
and images agree on it; no prediction speaks for it, so it is judged more strictly than tracking.
Where two places a room apart both explain the view, neither does: the ends of a corridor may be
furnished alike. Only places of one segment are compared so; where segments are to each other is not
known here.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice

import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3

from .align import AlignConfig
from .candidates import Candidate, apart_rad, attempt
from .features import (
    FeatureConfig,
    FeaturePose,
    Features,
    detect,
    detect_across_scales,
    estimate_pose,
)
from .judgement import History, JudgementConfig, Status, judge
from .keyframes import Keyframe
from .motion import extent
from .places import Place, Places, thumbnail_of
from .pyramid import Pyramid, PyramidConfig

PosedPlace = tuple[Place, FeaturePose]
NEWEST = 2  # places that a lost camera is looked for at each time: it may not have gone far
RANKED = 10  # times `alike`: places looked through for likely ones that are apart


@dataclass(frozen=True, slots=True)
class RelocalisationConfig:
    alike: int = 5  # places per lost frame, by thumbnail: the prototype's number
    in_turn: int = 3  # further ones: 1000 places in 11 s at 30 Hz
    across_scales: int = 8  # further ones in turn, by features that know near from far; 0: none
    attempts: int = 3  # direct alignments per search, the best feature poses first
    min_geometric_inliers: float = 0.85  # of the depths that meet a surface; the prototype's
    agreement_rad: float = 0.06  # rotation plus parallax between feature pose and alignment
    variety_rad: float = 0.25  # likely places nearer to each other than this are one
    rival_inliers: float = 0.3  # of the best place's: a place with more that says
    rival_rad: float = 1.0  # the camera is this far elsewhere (57 degrees, or a median depth)
    familiar: float = 0.4  # correlation with the last trusted thumbnail; below, a WEAK frame shows
    # another place. Kitchen, frame to frame: above 0.93; against another place: 97 % below

    def __post_init__(self) -> None:
        if self.alike < 0 or self.in_turn < 0 or self.alike + self.in_turn < 1:
            raise ConfigError("alike and in_turn must not be negative, nor both 0.")
        if self.attempts < 1 or self.across_scales < 0:
            raise ConfigError("attempts must be at least 1, across_scales at least 0.")
        if not min(self.agreement_rad, self.variety_rad, self.rival_rad) > 0:
            raise ConfigError("agreement_rad, variety_rad and rival_rad must be positive.")
        if not (0 <= self.min_geometric_inliers <= 1 and 0 <= self.rival_inliers <= 1):
            raise ConfigError("min_geometric_inliers and rival_inliers must be within 0..1.")
        if not 0 <= self.familiar <= 1:
            raise ConfigError(f"familiar={self.familiar:g}: a correlation within 0..1.")


@dataclass(frozen=True, slots=True)
class Relocaliser:
    """How a lost camera is found; knows nothing from frame to frame."""

    pyramid: PyramidConfig
    align: AlignConfig
    features: FeatureConfig
    judgement: JudgementConfig
    config: RelocalisationConfig

    def find(
        self, view: Pyramid, places: Places, turn: int, history: History, *, is_lost: bool = True
    ) -> tuple[Keyframe, Candidate] | None:
        """The keyframe that a view surely shows, and its alignment to it.

        `turn` counts the searches; it decides whose turn it is beside the likely places. A camera
        that is not lost must not wait: it is looked for by what is fast alone.
        """
        if not len(places):
            return None
        likely = self._likely(places.all[index] for index in places.alike(view))
        poses = self._poses(view, _each_once(likely, _due(places, turn, self.config.in_turn)))
        sure = self._surest(view, poses, history)
        if sure is None and is_lost and self.config.across_scales:
            newest, due = places.all[-NEWEST:], _due(places, turn, self.config.across_scales)
            others = self._poses_across_scales(view, _each_once(newest, due))
            sure, poses = self._surest(view, others, history), [*poses, *others]
        if sure is None or self._has_rival(*sure[0], poses):
            return None
        return sure[1]

    def is_familiar(self, view: Pyramid, trusted: np.ndarray) -> bool:
        """Whether a view looks like the thumbnail [300] of the last trusted one."""
        seen, trusted = thumbnail_of(view).astype(float), trusted.astype(float)
        scale = np.linalg.norm(seen) * np.linalg.norm(trusted)
        return bool(seen @ trusted >= self.config.familiar * scale > 0)

    def _likely(self, ranked: Iterable[Place]) -> list[Place]:
        """The first of each neighbourhood."""
        likely: list[Place] = []
        for place in islice(ranked, RANKED * self.config.alike):
            if len(likely) == self.config.alike:
                break
            if all(_is_apart(place, other, self.config.variety_rad) for other in likely):
                likely.append(place)
        return likely

    def _poses(self, view: Pyramid, places: Iterable[Place]) -> list[PosedPlace]:
        """Places with a feature pose, most inliers first."""
        seen = detect(view, self.features)
        return self._posed(view, seen, ((place, place.features) for place in places))

    def _poses_across_scales(self, view: Pyramid, places: Iterable[Place]) -> list[PosedPlace]:
        """Likewise, of a camera that has come much nearer or gone farther."""
        config = self.features
        image = view.gray, view.depth_m, view.camera
        seen = detect_across_scales(*image, config.count_across_scales, config)
        known = ((place, place.features_across_scales(config)) for place in places)
        return self._posed(view, seen, known)

    def _posed(
        self, view: Pyramid, seen: Features, known: Iterable[tuple[Place, Features]]
    ) -> list[PosedPlace]:
        poses = [(p, estimate_pose(there, seen, view.camera, self.features)) for p, there in known]
        found = [(place, pose) for place, pose in poses if pose is not None]
        return sorted(found, key=lambda pp: -pp[1].inliers)

    def _surest(
        self, view: Pyramid, poses: Sequence[PosedPlace], history: History
    ) -> tuple[PosedPlace, tuple[Keyframe, Candidate]] | None:
        """The first that the images confirm."""
        for place, pose in poses[: self.config.attempts]:
            keyframe = place.keyframe(self.pyramid)
            guess = se3.inverse(pose.T_camera_reference)
            candidate = attempt(keyframe, view, guess, "relocalised", self.align)
            if self._is_sure(candidate, guess, place.history(history)):
                return (place, pose), (keyframe, replace(candidate, second_agrees=True))
        return None

    def _is_sure(self, candidate: Candidate, guess: np.ndarray, history: History) -> bool:
        agrees = apart_rad(candidate, guess) < self.config.agreement_rad
        witnessed = replace(candidate, second_agrees=agrees)
        verdict = judge(witnessed, history, Status.LOST, self.judgement)
        inliers = candidate.alignment.geometric_inliers
        return verdict is Status.OK and inliers >= self.config.min_geometric_inliers

    def _has_rival(self, place: Place, pose: FeaturePose, poses: Iterable[PosedPlace]) -> bool:
        """Whether another place explains the view nearly as well, from far elsewhere."""
        T_odom_camera = _seen_from(place, pose)
        return any(
            other.segment == place.segment
            and rival.inliers > self.config.rival_inliers * pose.inliers
            and extent(se3.inverse(T_odom_camera) @ _seen_from(other, rival), place.median_depth_m)
            > self.config.rival_rad
            for other, rival in poses
        )


def _due(places: Places, turn: int, count: int) -> list[Place]:
    """Those whose turn it is: `count` each time, and from the first again."""
    numbers = range(turn * count, (turn + 1) * count)
    return [places.all[number % len(places)] for number in numbers]


def _each_once(*groups: Iterable[Place]) -> list[Place]:
    return list(dict.fromkeys(chain(*groups)))


def _seen_from(place: Place, pose: FeaturePose) -> np.ndarray:
    """T_odom_camera [4, 4]."""
    return place.T_odom_keyframe @ se3.inverse(pose.T_camera_reference)


def _is_apart(place: Place, other: Place, limit_rad: float) -> bool:
    T_other_place = se3.inverse(other.T_odom_keyframe) @ place.T_odom_keyframe
    is_far = extent(T_other_place, other.median_depth_m) > limit_rad
    return is_far or place.segment != other.segment
