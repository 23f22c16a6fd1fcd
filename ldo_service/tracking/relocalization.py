"""Relocalization of a lost camera and reuse of known keyframes. `ldo_service.geometry`.

A lost frame is compared with the places whose thumbnails are most like it, and with a few more
in turn, so that each frame costs the same however large the memory is, and every place has its
chance. Where its fast features find nothing, SIFT looks at others in turn, and at the newest: it
knows a room again from twice as far, for ten times the price. A place counts as found when features
and images agree on it; no prediction speaks for it, so it is judged more strictly than tracking.
Where two places a room apart both explain the view, neither does: the ends of a corridor may be
furnished alike. Only places of one submap are compared so; where submaps are to each other is not
known here.

A camera that makes keyframes wherever it goes fills a map with time, not with rooms: a robot on
its round would make the same ones every day. So once a map has many, a frame that is worth mapping
looks first for a known keyframe that shows the same, and new ones are made where there is none. A
known one counts only where the map already has the camera where the images put it: what has drifted
must be mapped on, so that a loop can be closed and the map be mended. A camera that comes from what
it has just mapped makes one keyframe more, measured from the known one: so the graph knows too.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import RelativePose

from .alignment import AlignConfig
from .features import (
    FeatureConfig,
    FeaturePose,
    Features,
    detect,
    detect_sift,
    estimate_pose,
)
from .keyframe_database import KeyframeDatabase, KeyframeRecord, make_thumbnail
from .keyframes import KeyframeConfig, ReferenceKeyframe, left_keyframe_view, limit_ratios
from .motion import image_motion_rad
from .pose_candidates import PoseHypothesis, align_hypothesis, hypothesis_distance_rad
from .pyramid import Pyramid, PyramidConfig
from .tracking_quality import (
    ResidualHistory,
    TrackingQualityConfig,
    TrackingStatus,
    classify_tracking,
)

NEWEST = 2  # places that a lost camera is looked for at each time: it may not have gone far
RANKED = 10  # times `alike`: places looked through for likely ones that are apart


PosedPlace = tuple[KeyframeRecord, FeaturePose]


@dataclass(frozen=True, slots=True)
class RelocalizationConfig:
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
class Relocalizer:
    """How a lost camera is found; knows nothing from frame to frame."""

    pyramid: PyramidConfig
    align: AlignConfig
    features: FeatureConfig
    judgement: TrackingQualityConfig
    config: RelocalizationConfig

    def find(
        self,
        view: Pyramid,
        places: KeyframeDatabase,
        turn: int,
        history: ResidualHistory,
        *,
        is_lost: bool = True,
    ) -> tuple[ReferenceKeyframe, PoseHypothesis] | None:
        """The keyframe that a view surely shows, and its alignment to it.

        `turn` counts the searches; it decides whose turn it is beside the likely places. A camera
        that is not lost must not wait: it is looked for by what is fast alone.
        """
        if not len(places):
            return None
        likely = self._distinct_candidates(
            places.all[index] for index in places.rank_by_similarity(view)
        )
        poses = self._poses(view, _each_once(likely, _due(places, turn, self.config.in_turn)))
        sure = self._first_verified(view, poses, history)
        if sure is None and is_lost and self.config.across_scales:
            newest, due = places.all[-NEWEST:], _due(places, turn, self.config.across_scales)
            others = self._poses_across_scales(view, _each_once(newest, due))
            sure, poses = self._first_verified(view, others, history), [*poses, *others]
        if sure is None or self._is_ambiguous(*sure[0], poses):
            return None
        return sure[1]

    def resembles_last_trusted(self, view: Pyramid, trusted: np.ndarray) -> bool:
        """Whether a view looks like the thumbnail [300] of the last trusted one."""
        seen, trusted = make_thumbnail(view).astype(float), trusted.astype(float)
        scale = np.linalg.norm(seen) * np.linalg.norm(trusted)
        return bool(seen @ trusted >= self.config.familiar * scale > 0)

    def _distinct_candidates(self, ranked: Iterable[KeyframeRecord]) -> list[KeyframeRecord]:
        """The first of each neighbourhood."""
        likely: list[KeyframeRecord] = []
        for place in islice(ranked, RANKED * self.config.alike):
            if len(likely) == self.config.alike:
                break
            if all(_is_apart(place, other, self.config.variety_rad) for other in likely):
                likely.append(place)
        return likely

    def _poses(self, view: Pyramid, places: Iterable[KeyframeRecord]) -> list[PosedPlace]:
        """Places with a feature pose, most inliers first."""
        seen = detect(view, self.features)
        return self._posed(view, seen, ((place, place.features) for place in places))

    def _poses_across_scales(
        self, view: Pyramid, places: Iterable[KeyframeRecord]
    ) -> list[PosedPlace]:
        """Likewise, of a camera that has come much nearer or gone farther."""
        config = self.features
        image = view.gray, view.depth_m, view.camera
        seen = detect_sift(*image, config.count_across_scales, config)
        known = ((place, place.sift_features(config)) for place in places)
        return self._posed(view, seen, known)

    def _posed(
        self, view: Pyramid, seen: Features, known: Iterable[tuple[KeyframeRecord, Features]]
    ) -> list[PosedPlace]:
        poses = [(p, estimate_pose(there, seen, view.camera, self.features)) for p, there in known]
        found = [(place, pose) for place, pose in poses if pose is not None]
        return sorted(found, key=lambda pp: -pp[1].inliers)

    def _first_verified(
        self, view: Pyramid, poses: Sequence[PosedPlace], history: ResidualHistory
    ) -> tuple[PosedPlace, tuple[ReferenceKeyframe, PoseHypothesis]] | None:
        """The first that the images confirm."""
        for place, pose in poses[: self.config.attempts]:
            keyframe = place.keyframe(self.pyramid)
            guess = se3.inverse(pose.T_camera_reference)
            candidate = align_hypothesis(keyframe, view, guess, "relocalized", self.align)
            if self._is_sure(candidate, guess, place.history(history)):
                return (place, pose), (keyframe, replace(candidate, is_confirmed=True))
        return None

    def _is_sure(
        self, candidate: PoseHypothesis, guess: np.ndarray, history: ResidualHistory
    ) -> bool:
        agrees = hypothesis_distance_rad(candidate, guess) < self.config.agreement_rad
        witnessed = replace(candidate, is_confirmed=agrees)
        verdict = classify_tracking(witnessed, history, TrackingStatus.LOST, self.judgement)
        inliers = candidate.alignment.geometric_inliers
        return verdict is TrackingStatus.OK and inliers >= self.config.min_geometric_inliers

    def _is_ambiguous(
        self, place: KeyframeRecord, pose: FeaturePose, poses: Iterable[PosedPlace]
    ) -> bool:
        """Whether another place explains the view nearly as well, from far elsewhere."""
        T_odom_camera = _seen_from(place, pose)
        return any(
            other.submap == place.submap
            and rival.inliers > self.config.rival_inliers * pose.inliers
            and image_motion_rad(
                se3.inverse(T_odom_camera) @ _seen_from(other, rival), place.median_depth_m
            )
            > self.config.rival_rad
            for other, rival in poses
        )


def _due(places: KeyframeDatabase, turn: int, count: int) -> list[KeyframeRecord]:
    """Those whose turn it is: `count` each time, and from the first again."""
    numbers = range(turn * count, (turn + 1) * count)
    return [places.all[number % len(places)] for number in numbers]


def _each_once(*groups: Iterable[KeyframeRecord]) -> list[KeyframeRecord]:
    return list(dict.fromkeys(chain(*groups)))


def _seen_from(place: KeyframeRecord, pose: FeaturePose) -> np.ndarray:
    """T_odom_camera [4, 4]."""
    return place.T_odom_keyframe @ se3.inverse(pose.T_camera_reference)


def _is_apart(place: KeyframeRecord, other: KeyframeRecord, limit_rad: float) -> bool:
    T_other_place = se3.inverse(other.T_odom_keyframe) @ place.T_odom_keyframe
    is_far = image_motion_rad(T_other_place, other.median_depth_m) > limit_rad
    return is_far or place.submap != other.submap


Nearby = tuple[KeyframeRecord, np.ndarray]  # a place, and T_place_camera [4, 4] as the map has it


@dataclass(frozen=True, slots=True)
class KeyframeReuseConfig:
    after: int = 1500  # keyframes, supporting ones too: from then on known ones are looked for; 0:
    # never. Until then the map gains more by new views than they take, a few kB each
    tries: int = 2  # places per frame, the nearest first: 8 ms each at 640x480
    agreement_rad: float = 0.03  # rotation plus parallax between map and images, 3 % of the median
    # depth; above, keyframes are made until a loop is closed
    min_geometric_inliers: float = 0.85  # of the depths that meet a surface, as when relocalised

    def __post_init__(self) -> None:
        if self.after < 0 or self.tries < 1:
            raise ConfigError(
                named(self, "after", "tries") + ": after must be at least 0, tries at least 1."
            )
        if not (self.agreement_rad > 0 and 0 <= self.min_geometric_inliers <= 1):
            raise ConfigError(
                named(self, "agreement_rad", "min_geometric_inliers")
                + ": agreement_rad must be positive, min_geometric_inliers within 0..1."
            )


@dataclass(frozen=True, eq=False, slots=True)
class ReusedKeyframe:
    """A place, the keyframe that it was, and the alignment of a view to that."""

    place: KeyframeRecord
    keyframe: ReferenceKeyframe
    candidate: PoseHypothesis

    def measures(self, keyframe: int) -> RelativePose:
        """The pose of the keyframe that the view was made."""
        seen = self.candidate.alignment
        return RelativePose(self.place.id, keyframe, seen.T_reference_camera, seen.information)


@dataclass(frozen=True, slots=True)
class KeyframeReuse:
    """How a known keyframe is found to go on against; knows nothing from frame to frame."""

    pyramid: PyramidConfig
    align: AlignConfig
    keyframes: KeyframeConfig
    judgement: TrackingQualityConfig
    config: KeyframeReuseConfig

    def find(
        self, view: Pyramid, near: Sequence[Nearby], history: ResidualHistory
    ) -> ReusedKeyframe | None:
        """The first that a view surely shows, from where the map has the camera, and has not left.

        history  noise of the frames before: the next ones are judged by it too
        """
        for place, T_place_camera in near[: self.config.tries]:
            keyframe = place.keyframe(self.pyramid)
            candidate = align_hypothesis(keyframe, view, T_place_camera, "reused", self.align)
            histories = history, place.history(history)
            if self._is_sure(candidate, T_place_camera, histories):
                return ReusedKeyframe(place, keyframe, candidate)
        return None

    def _is_sure(
        self,
        candidate: PoseHypothesis,
        T_place_camera: np.ndarray,
        histories: Sequence[ResidualHistory],
    ) -> bool:
        seen, T = candidate.alignment, candidate.alignment.T_reference_camera
        agrees = hypothesis_distance_rad(candidate, T_place_camera) < self.config.agreement_rad
        witnessed = replace(candidate, is_confirmed=agrees)
        return (
            not left_keyframe_view(T, seen.overlap, candidate.median_depth_m, self.keyframes)
            and seen.geometric_inliers >= self.config.min_geometric_inliers
            and all(
                classify_tracking(witnessed, history, TrackingStatus.OK, self.judgement)
                is TrackingStatus.OK
                for history in histories
            )
        )


def find_nearby_keyframes(
    places: Sequence[KeyframeRecord],
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
    left = limit_ratios(T_camera, np.array([place.median_depth_m for place in known]), config)
    order = np.argsort(left, kind="stable")
    return [(known[k], T_camera[k]) for k in order if left[k] <= 1]
