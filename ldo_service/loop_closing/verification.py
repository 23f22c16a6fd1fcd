"""Verification of loop candidates, which are pairs of similar subgraphs.

A subgraph is a group of consecutive keyframes. `place_database` finds the loop candidates. For each
candidate, a pose between an old and a new keyframe is estimated from ORB features, from landmarks
or from the map. Landmarks or a second new keyframe must confirm this pose, and landmarks must not
contradict it. Direct alignment then refines the pose on the images. A large change of the pose is
rejected. At the refined pose, the surfaces must overlap without conflict. Conventions of poses:
`ldo_service.geometry`.
"""

from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import islice
from typing import Literal

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import RelativePose
from ldo_service.tracking.alignment import AlignConfig, Alignment, align
from ldo_service.tracking.features import FeatureConfig, estimate_pose
from ldo_service.tracking.keyframes import ReferenceKeyframe
from ldo_service.tracking.motion import image_motion_rad
from ldo_service.tracking.pyramid import PyramidConfig

from .keyframe_pairs import KnownPose, likely_pairs, nearest_pairs, relative_pose
from .object_points import (
    LandmarkAgreement,
    LandmarkConfig,
    compare_landmarks,
    compare_landmarks_at,
    possible_pairs,
)
from .pose_estimation import (
    DepthConsistency,
    DepthConsistencyConfig,
    check_depth_consistency,
    ransac_rigid,
)
from .subgraph import Subgraph, SubgraphKeyframe

NOTHING = LandmarkAgreement(0, 0, 0.0, 0.0)
Evidence = Literal["", "landmarks", "features", "map"]
# Maximum decompressed keyframes in the cache, 3 MB each: of a new subgraph and some candidates.
OPENED = 12
FIT_LEVEL = 1  # Pyramid level of 160 pixels width: 19,200 points suffice for the overlap.


@dataclass(frozen=True, slots=True)
class VerificationConfig:
    """Parameters of the verification of loop candidates.

    A loop candidate is a pair of similar subgraphs, which are groups of consecutive keyframes.
    """

    landmarks: LandmarkConfig = field(default_factory=LandmarkConfig)
    fit: DepthConsistencyConfig = field(default_factory=DepthConsistencyConfig)
    # Minimum feature inliers of the best pair; a confirming pair needs `features.min_inliers`.
    min_inliers: int = 20
    # Minimum number of matching landmarks that confirm a pose from features, if no second keyframe
    # gives the same pose.
    confirming_landmarks: int = 3
    # Maximum rotation plus parallax between two poses from features that confirm each other.
    confirmation_rad: float = 0.08
    pairs: int = 15  # Maximum pairs of keyframes for feature matching, 3 ms each.
    map_pairs: int = 3  # Maximum pairs of keyframes aligned at their poses in the map, 15 ms each.
    # Minimum overlap of both surfaces if the pose comes from landmarks.
    blind_overlap: float = 0.35
    # Minimum overlap of both surfaces if the pose comes from the map. From this overlap on, the
    # evaluation counts two keyframes as a loop.
    map_overlap: float = 0.3
    # Maximum rotation plus parallax between two refined poses from the map that confirm each other;
    # 0.02 rad is a distance of 4 cm at a depth of 2 m.
    map_confirmation_rad: float = 0.02
    # Maximum rotation plus parallax by which the refinement on the images may change a pose from
    # features or from the map.
    refined_rad: float = 0.1
    # The same limit for a pose from landmarks. It is larger because landmarks are inaccurate.
    refined_landmarks_rad: float = 0.4
    # Maximum condition number of the information matrix, with translations in median depths, as in
    # the tracker.
    max_condition: float = 1e5
    max_gain: float = 3.0  # Maximum ratio of the brightness of both images, in either direction.
    # Maximum number of landmarks that may contradict a pose. If more landmarks than this match, as
    # many as match may contradict.
    max_contradictions: int = 3

    def __post_init__(self) -> None:
        if self.min_inliers < 6 or self.pairs < 1:
            raise ConfigError(
                named(self, "min_inliers", "pairs")
                + ": min_inliers must be at least 6, pairs must be at least 1."
            )
        if not (0 <= self.blind_overlap <= 1 and 0 <= self.map_overlap <= 1):
            raise ConfigError(
                named(self, "blind_overlap", "map_overlap")
                + ": blind_overlap and map_overlap must be within 0..1."
            )
        angles = (self.confirmation_rad, self.refined_rad, self.refined_landmarks_rad)
        if min(*angles, self.map_confirmation_rad) <= 0 or self.map_pairs < 0:
            raise ConfigError(
                named(
                    self,
                    "confirmation_rad",
                    "map_pairs",
                    "map_confirmation_rad",
                    "refined_rad",
                    "refined_landmarks_rad",
                )
                + ": the values in radians must be positive, map_pairs must not be negative."
            )


@dataclass(frozen=True, eq=False, slots=True)
class LoopHypothesis:
    """Loop hypothesis: a pose between an old and a new keyframe, not yet verified."""

    old: SubgraphKeyframe  # Keyframe of the old subgraph.
    new: SubgraphKeyframe  # Keyframe of the new subgraph.
    T_old_new: np.ndarray  # Pose of the new keyframe in the old one, [4, 4].
    evidence: Evidence = ""  # Source of the pose; "" if no pose was found.
    inliers: int = 0  # Number of features or landmarks that agree with the pose.
    semantics: LandmarkAgreement = NOTHING  # Agreement of the landmarks at this pose.
    rejected_reason: str = ""  # Reason of the rejection; "" if the hypothesis is not rejected.


@dataclass(frozen=True, eq=False, slots=True)
class VerificationResult:
    """Result of the verification of a loop hypothesis."""

    proposal: LoopHypothesis  # The hypothesis.
    overlap: float = 0.0  # Fraction of the new surface that the old keyframe also sees, 0..1.
    rmse_m: float = 0.0  # Root mean square distance of both surfaces along the normals, meters.
    rejected_reason: str = ""  # Reason of the rejection; "" if the hypothesis is accepted.
    closure: RelativePose | None = None  # Loop closure with the refined pose; None if rejected.


class Verifier:
    """Verifier of loop candidates, which are pairs of similar subgraphs.

    Equal subgraphs give bitwise equal results. Recently decompressed keyframes are cached.
    """

    def __init__(
        self,
        pyramid: PyramidConfig,
        align: AlignConfig,
        features: FeatureConfig,
        config: VerificationConfig,
        min_gap_frames: int,
    ) -> None:
        """Prepare a verifier with an empty cache.

        Args:
            pyramid: Settings of the image pyramids.
            align: Settings of direct alignment.
            features: Settings of feature matching.
            config: Limits of the verification.
            min_gap_frames: The keyframes of a closure are more than this number of frames apart.
        """
        self._align, self._features, self._config = align, features, config
        self._min_gap_frames = min_gap_frames
        self._opened = lru_cache(OPENED)(lambda view: view.place.keyframe(pyramid))

    # --- hypotheses -------------------------------------------------------------------------------
    def hypothesis_from_features(self, old: Subgraph, new: Subgraph) -> LoopHypothesis:
        """Return the pose with the most feature inliers, marked as rejected if it is not confirmed.

        Each pair of an old and a new keyframe gives a pose from its feature matches. A pose is
        confirmed if a pair with another new keyframe gives nearly the same pose. The search ends
        with the first confirmed pose. If there is none, matching landmarks or the verification of
        another new keyframe can confirm the pose with the most inliers.
        """
        found: list[LoopHypothesis] = []
        for a, b in islice(likely_pairs(old, new, self._min_gap_frames), self._config.pairs):
            pose = estimate_pose(a.place.features, b.place.features, b.place.camera, self._features)
            if pose is not None:
                T_old_new = se3.inverse(pose.T_camera_reference)
                found.append(LoopHypothesis(a, b, T_old_new, "features", pose.inliers))
                best = max(found, key=lambda proposal: proposal.inliers)
                is_enough = best.inliers >= self._config.min_inliers
                if is_enough and self._is_confirmed_by_any(
                    best, found, self._config.confirmation_rad
                ):
                    return self._with_semantics(best, old, new)
        return self._from_single_keyframe(found, old, new)

    def _from_single_keyframe(
        self, found: list[LoopHypothesis], old: Subgraph, new: Subgraph
    ) -> LoopHypothesis:
        """Return the pose with the most inliers among `found`, rejected if it is not confirmed.

        A pose with fewer than `min_inliers` inliers is also rejected. The pose is confirmed by at
        least `confirming_landmarks` matching landmarks, or by another keyframe of `new` whose
        images pass the verification at this pose.
        """
        best = max(found, key=lambda proposal: proposal.inliers, default=None)
        if best is None:
            return LoopHypothesis(
                old.views[0], new.views[0], np.eye(4), rejected_reason="no pose fits the features"
            )
        best = self._with_semantics(best, old, new)
        if best.inliers < self._config.min_inliers:
            return replace(best, rejected_reason=f"{best.inliers} features agree, too few")
        if best.semantics.count >= self._config.confirming_landmarks:
            return best
        if any(self._is_confirmed_by(best, view) for view in new.views if view is not best.new):
            return best
        return replace(best, rejected_reason="not confirmed by a second keyframe")

    def _is_confirmed_by(self, best: LoopHypothesis, view: SubgraphKeyframe) -> bool:
        """Return whether a pose passes the verification with another new keyframe, `view`."""
        T_old_view = relative_pose(best.old, view, _odometry_frames(best))
        check = self.verify(replace(best, new=view, T_old_new=T_old_view))
        return check.closure is not None

    def _is_confirmed_by_any(
        self, best: LoopHypothesis, found: list[LoopHypothesis], within_rad: float
    ) -> bool:
        """Return whether a hypothesis in `found` for another new keyframe confirms `best`.

        It does if the two poses differ by less than `within_rad`, rotation plus parallax.
        """
        return any(
            image_motion_rad(se3.inverse(best.T_old_new) @ _as_seen_by(best, other), _depth(best))
            < within_rad
            for other in found
            if other.new is not best.new
        )

    def hypothesis_from_landmarks(self, old: Subgraph, new: Subgraph) -> LoopHypothesis:
        """Return the relative pose of two subgraphs, estimated from their landmarks.

        RANSAC finds the relative pose at which the most landmarks coincide. The hypothesis contains
        this pose for the pair of keyframes that are nearest to each other. The hypothesis is
        rejected if fewer than `landmarks.min_inliers` landmarks coincide.
        """
        config = self._config.landmarks
        pairs = possible_pairs(old.landmarks, new.landmarks, config)
        points = old.landmarks.p_odom, new.landmarks.p_odom
        rng = np.random.default_rng(0)
        motion = ransac_rigid(*points, pairs, config.reach_m, config.iterations, rng)
        count = 0 if motion is None else int(motion.inliers.sum())
        if motion is None or count < config.min_inliers:
            reason = f"{count} landmarks agree, too few"
            return LoopHypothesis(old.views[0], new.views[0], np.eye(4), rejected_reason=reason)
        semantics = compare_landmarks(old.landmarks, new.landmarks, pairs[motion.inliers])

        def T_old_new(a: SubgraphKeyframe, b: SubgraphKeyframe) -> np.ndarray:
            return relative_pose(a, b, motion.T_a_b)

        pair = next(nearest_pairs(old, new, T_old_new, self._min_gap_frames), None)
        if pair is None:
            reason = "the stored keyframes are too recent"
            return LoopHypothesis(old.views[0], new.views[0], np.eye(4), rejected_reason=reason)
        return LoopHypothesis(*pair, "landmarks", count, semantics)

    def hypothesis_from_map(
        self, old: Subgraph, new: Subgraph, T_old_new: KnownPose
    ) -> LoopHypothesis:
        """Refine poses from the map by image alignment, and return the first confirmed pose.

        Up to `map_pairs` pairs of an old and a new keyframe are aligned, the nearest pairs first.
        Each alignment starts at the pose of the pair in the map, `T_old_new`, and refines it. Two
        refined poses confirm each other if they come from different new keyframes and differ by
        less than `map_confirmation_rad`. The first confirmed pose is returned. If there is none,
        the returned hypothesis is rejected.

        This method needs no features, so it also works for images from different viewpoints. After
        a large drift, it finds no loop closure, because the poses in the map are too inaccurate.
        """
        found: list[LoopHypothesis] = []
        pairs = nearest_pairs(old, new, T_old_new, self._min_gap_frames)
        for a, b, T in islice(pairs, self._config.map_pairs):
            check = self._check_overlap(LoopHypothesis(a, b, T, "map"))
            if check is not None and check.closure is not None:
                met = replace(check.proposal, T_old_new=check.closure.T_a_b)
                if self._is_confirmed_by_any(met, found, self._config.map_confirmation_rad):
                    return self._with_semantics(met, old, new)
                found.append(met)
        refused = "not confirmed by images" if found else "images do not fit the pose in the map"
        return LoopHypothesis(old.views[0], new.views[0], np.eye(4), rejected_reason=refused)

    def _check_overlap(self, proposal: LoopHypothesis) -> VerificationResult | None:
        """Verify a hypothesis; return None, without alignment, if surfaces overlap too little."""
        old, new = self._opened(proposal.old), self._opened(proposal.new)
        T_old_new, least = proposal.T_old_new, self._config.map_overlap
        if self._fit(old, new, T_old_new).overlap < least:
            return None
        if self._fit(new, old, se3.inverse(T_old_new)).overlap < least:
            return None
        return self.verify(proposal)

    def _with_semantics(
        self, proposal: LoopHypothesis, old: Subgraph, new: Subgraph
    ) -> LoopHypothesis:
        """Return a hypothesis with the agreement of the landmarks at its relative pose."""
        T, config = _odometry_frames(proposal), self._config.landmarks
        semantics = compare_landmarks_at(old.landmarks, new.landmarks, T, config)
        return replace(proposal, semantics=semantics)

    # --- verification -----------------------------------------------------------------------------
    def verify(self, proposal: LoopHypothesis) -> VerificationResult:
        """Refine a pose by direct alignment of the images, and check the surfaces at this pose.

        The pose is also rejected if too many landmarks contradict it (`proposal.semantics`).
        """
        old, new = self._opened(proposal.old), self._opened(proposal.new)
        alignment = align(old.reference, new.view, se3.inverse(proposal.T_old_new), self._align)
        fit = self._fit(old, new, alignment.T_reference_camera)
        back = self._fit(new, old, se3.inverse(alignment.T_reference_camera))
        refused = self._rejection_reason(proposal, alignment, fit, min(fit.overlap, back.overlap))
        measured = RelativePose(
            proposal.old.keyframe,
            proposal.new.keyframe,
            alignment.T_reference_camera,
            alignment.information,
        )
        closure = None if refused else measured
        return VerificationResult(proposal, min(fit.overlap, 1.0), fit.rmse_m, refused, closure)

    def accept_unverified(self, proposal: LoopHypothesis) -> VerificationResult:
        """Accept the pose from landmarks as a loop closure without refinement or checks.

        The LDO-SLAM paper also accepts loop closures right after the comparison of landmarks. The
        mode `semantic` does the same, so that the paper's method can be compared with other modes.
        """
        sigma_m = self._config.landmarks.reach_m / np.sqrt(proposal.inliers)
        sigmas = np.repeat([sigma_m / _depth(proposal), sigma_m], 3)
        a, b = proposal.old.keyframe, proposal.new.keyframe
        closure = RelativePose(a, b, proposal.T_old_new, np.diag(sigmas**-2))
        return VerificationResult(proposal, closure=closure)

    def _fit(
        self, old: ReferenceKeyframe, new: ReferenceKeyframe, T_old_new: np.ndarray
    ) -> DepthConsistency:
        level = min(FIT_LEVEL, len(old.view.levels) - 1, len(new.view.levels) - 1)
        points, there = new.reference.points[level], old.view.levels[level]
        return check_depth_consistency(
            points, T_old_new, there.depth_m, there.camera, self._config.fit
        )

    def _min_overlap(self, evidence: Evidence) -> float:
        config = self._config
        by_map = config.map_overlap if evidence == "map" else config.blind_overlap
        return config.fit.min_overlap if evidence == "features" else by_map

    def _rejection_reason(
        self, proposal: LoopHypothesis, alignment: Alignment, fit: DepthConsistency, shared: float
    ) -> str:
        """Return the reason to reject a pose, or "" to accept it.

        Args:
            proposal: The hypothesis with the pose before refinement.
            alignment: Result of the refinement on the images.
            fit: Comparison of the new surface with the old depth at the refined pose.
            shared: The smaller of two overlaps, 0..1: that of the new surface in the old view, and
                that of the old surface in the new view.
        """
        config, by_landmarks = self._config, proposal.evidence == "landmarks"
        moved = se3.inverse(proposal.T_old_new) @ alignment.T_reference_camera
        limit = config.refined_landmarks_rad if by_landmarks else config.refined_rad
        if image_motion_rad(moved, _depth(proposal)) > limit:
            return "images and " + proposal.evidence + " disagree"
        if alignment.condition > config.max_condition:
            return "degenerate alignment"
        if abs(np.log(max(alignment.gain, 1e-6))) > np.log(config.max_gain):
            return f"brightness ratio {alignment.gain:.2f} is out of range"
        if shared < self._min_overlap(proposal.evidence):
            return f"overlap of only {shared:.2f}"
        if fit.rmse_m > config.fit.max_rmse_m:
            return f"surfaces are {100 * fit.rmse_m:.1f} cm apart"
        if fit.conflict > config.fit.max_conflict:
            return f"{fit.conflict:.0%} of the surface lies in free space"
        seen = proposal.semantics
        if seen.contradicted > max(config.max_contradictions, seen.count):
            return f"{seen.contradicted} landmarks contradict the pose"
        return ""


def _odometry_frames(proposal: LoopHypothesis) -> np.ndarray:
    """Return T_oldodom_newodom [4, 4] of the odometry frames, as a hypothesis implies it."""
    T_odom_old = proposal.old.place.T_odom_keyframe
    return T_odom_old @ proposal.T_old_new @ se3.inverse(proposal.new.place.T_odom_keyframe)


def _as_seen_by(best: LoopHypothesis, other: LoopHypothesis) -> np.ndarray:
    """Return T_old_new [4, 4] of the two keyframes of `best`, as the hypothesis `other` implies."""
    return relative_pose(best.old, best.new, _odometry_frames(other))


def _depth(proposal: LoopHypothesis) -> float:
    """Return the median depth of the new keyframe in meters."""
    return proposal.new.place.median_depth_m
