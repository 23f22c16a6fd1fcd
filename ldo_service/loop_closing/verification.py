"""Whether two subgraphs show one place, and the pose between two of their keyframes (fine stage).

A pose comes from ORB features, from landmarks or from the map, is refined on the images, and is
believed when all of this agrees: two keyframes of the new subgraph, the refined pose, the surfaces,
and what the detector named. Conventions: `ldo_service.geometry`.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import islice, product
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
KnownPose = Callable[
    [SubgraphKeyframe, SubgraphKeyframe], np.ndarray | None
]  # T_old_new [4, 4]; None: not known
OPENED = 12  # keyframes kept ready for alignment, 3 MB each: a query and some candidates
FIT_LEVEL = 1  # of the pyramid, 160 pixels wide: 19,200 points say what overlaps


@dataclass(frozen=True, slots=True)
class VerificationConfig:
    landmarks: LandmarkConfig = field(default_factory=LandmarkConfig)
    fit: DepthConsistencyConfig = field(default_factory=DepthConsistencyConfig)
    min_inliers: int = 20  # features that agree on the pose, of the best pair of keyframes; another
    # keyframe of the new subgraph that says the same needs `features.min_inliers` alone
    witness_landmarks: int = 3  # or landmarks of one kind that it brings together
    witness_rad: float = 0.08  # rotation plus parallax between what the two say
    pairs: int = 15  # of keyframes whose features are matched, at 3 ms each
    map_pairs: int = 3  # of keyframes that are aligned where the map has them, at 15 ms each
    blind_overlap: float = 0.35  # of either's surface, where no features vouch for the pose
    map_witness_rad: float = 0.02  # between what two of these say: half a centimetre in a room
    refined_rad: float = 0.1  # how far the images may move the pose of the features, or of the map,
    refined_landmarks_rad: float = 0.4  # and that of landmarks, whose centres are vague
    max_condition: float = 1e5  # of the information in median depths, as the tracker's
    max_gain: float = 3.0  # of brightness, either way
    max_contradictions: int = 3  # landmarks where others of another kind were, if they are most

    def __post_init__(self) -> None:
        if self.min_inliers < 6 or self.pairs < 1:
            raise ConfigError(
                named(self, "min_inliers", "pairs")
                + ": inliers must be at least 6, pairs at least 1."
            )
        if not 0 <= self.blind_overlap <= 1:
            raise ConfigError(f"blind_overlap={self.blind_overlap:g} must be within 0..1.")
        angles = (self.witness_rad, self.refined_rad, self.refined_landmarks_rad)
        if min(*angles, self.map_witness_rad) <= 0 or self.map_pairs < 0:
            raise ConfigError(
                named(
                    self,
                    "witness_rad",
                    "map_pairs",
                    "map_witness_rad",
                    "refined_rad",
                    "refined_landmarks_rad",
                )
                + ": angles must be positive, map_pairs not negative."
            )


@dataclass(frozen=True, eq=False, slots=True)
class LoopHypothesis:
    """A pose between two keyframes, T_old_new [4, 4]; `refused` says why it goes no further."""

    old: SubgraphKeyframe
    new: SubgraphKeyframe
    T_old_new: np.ndarray
    evidence: Evidence = ""  # "": there is no pose
    inliers: int = 0
    semantics: LandmarkAgreement = NOTHING
    rejected_reason: str = ""


@dataclass(frozen=True, eq=False, slots=True)
class VerificationResult:
    """What came of a proposal; the closure if nothing speaks against it."""

    proposal: LoopHypothesis
    overlap: float = 0.0
    rmse_m: float = 0.0
    rejected_reason: str = ""
    closure: RelativePose | None = None


class Verifier:
    """Deterministic: the same subgraphs give the same bits. Keeps what it decompressed last."""

    def __init__(
        self,
        pyramid: PyramidConfig,
        align: AlignConfig,
        features: FeatureConfig,
        config: VerificationConfig,
    ) -> None:
        self._align, self._features, self._config = align, features, config
        self._opened = lru_cache(OPENED)(lambda view: view.place.keyframe(pyramid))

    # --- a pose -----------------------------------------------------------------------------------
    def hypothesis_from_features(self, old: Subgraph, new: Subgraph) -> LoopHypothesis:
        """The pose that features of two new keyframes agree on."""
        found: list[LoopHypothesis] = []
        for a, b in islice(_likely_pairs(old, new), self._config.pairs):
            pose = estimate_pose(a.place.features, b.place.features, b.place.camera, self._features)
            if pose is not None:
                T_old_new = se3.inverse(pose.T_camera_reference)
                found.append(LoopHypothesis(a, b, T_old_new, "features", pose.inliers))
                best = max(found, key=lambda proposal: proposal.inliers)
                is_enough = best.inliers >= self._config.min_inliers
                if is_enough and self._is_confirmed_by_any(best, found, self._config.witness_rad):
                    return self._with_semantics(best, old, new)
        return self._from_single_keyframe(found, old, new)

    def _from_single_keyframe(
        self, found: list[LoopHypothesis], old: Subgraph, new: Subgraph
    ) -> LoopHypothesis:
        """What a single keyframe says; images of another, or three landmarks, may vouch for it."""
        best = max(found, key=lambda proposal: proposal.inliers, default=None)
        if best is None:
            return LoopHypothesis(
                old.views[0], new.views[0], np.eye(4), rejected_reason="no pose fits features"
            )
        best = self._with_semantics(best, old, new)
        if best.inliers < self._config.min_inliers:
            return replace(best, rejected_reason=f"{best.inliers} features agree")
        if best.semantics.count >= self._config.witness_landmarks:
            return best
        if any(self._is_confirmed_by(best, view) for view in new.views if view is not best.new):
            return best
        return replace(best, rejected_reason="not confirmed by a second keyframe")

    def _is_confirmed_by(self, best: LoopHypothesis, view: SubgraphKeyframe) -> bool:
        """Whether the image and surface of another new keyframe are as a pose predicts."""
        T_old_view = _between(best.old, view, _odometry_frames(best))
        check = self.verify(replace(best, new=view, T_old_new=T_old_view))
        return check.closure is not None

    def _is_confirmed_by_any(
        self, best: LoopHypothesis, found: list[LoopHypothesis], within_rad: float
    ) -> bool:
        """Whether another new keyframe says the same."""
        return any(
            image_motion_rad(se3.inverse(best.T_old_new) @ _as_seen_by(best, other), _depth(best))
            < within_rad
            for other in found
            if other.new is not best.new
        )

    def hypothesis_from_landmarks(self, old: Subgraph, new: Subgraph) -> LoopHypothesis:
        """The pose that most landmarks agree on, between the keyframes that then see most alike."""
        config = self._config.landmarks
        pairs = possible_pairs(old.landmarks, new.landmarks, config)
        points = old.landmarks.p_odom, new.landmarks.p_odom
        rng = np.random.default_rng(0)
        motion = ransac_rigid(*points, pairs, config.reach_m, config.iterations, rng)
        count = 0 if motion is None else int(motion.inliers.sum())
        if motion is None or count < config.min_inliers:
            reason = f"{count} landmarks agree"
            return LoopHypothesis(old.views[0], new.views[0], np.eye(4), rejected_reason=reason)
        semantics = compare_landmarks(old.landmarks, new.landmarks, pairs[motion.inliers])
        nearest = _nearest_pairs(old, new, lambda a, b: _between(a, b, motion.T_a_b))
        a, b, T_old_new = next(nearest)
        return LoopHypothesis(a, b, T_old_new, "landmarks", count, semantics)

    def hypothesis_from_map(
        self, old: Subgraph, new: Subgraph, T_old_new: KnownPose
    ) -> LoopHypothesis:
        """Where the map has them, if that brings them together, and the images of two new keyframes
        refine it to one and the same pose: what sees a place from elsewhere shares few features.

        It finds no loop that drift tore open; it ties what was seen twice before it drifts apart.
        """
        found: list[LoopHypothesis] = []
        for a, b, T in islice(_nearest_pairs(old, new, T_old_new), self._config.map_pairs):
            check = self._check_overlap(LoopHypothesis(a, b, T, "map"))
            if check is not None and check.closure is not None:
                met = replace(check.proposal, T_old_new=check.closure.T_a_b)
                if self._is_confirmed_by_any(met, found, self._config.map_witness_rad):
                    return self._with_semantics(met, old, new)
                found.append(met)
        refused = "not confirmed by images" if found else "no overlap at the mapped pose"
        return LoopHypothesis(old.views[0], new.views[0], np.eye(4), rejected_reason=refused)

    def _check_overlap(self, proposal: LoopHypothesis) -> VerificationResult | None:
        """None, without an alignment, where either sees too little of what the other does."""
        old, new = self._opened(proposal.old), self._opened(proposal.new)
        T_old_new, least = proposal.T_old_new, self._config.blind_overlap
        if self._fit(old, new, T_old_new).overlap < least:
            return None
        if self._fit(new, old, se3.inverse(T_old_new)).overlap < least:
            return None
        return self.verify(proposal)

    def _with_semantics(
        self, proposal: LoopHypothesis, old: Subgraph, new: Subgraph
    ) -> LoopHypothesis:
        """What the landmarks say of a pose: those in one place should be of one kind."""
        T, config = _odometry_frames(proposal), self._config.landmarks
        semantics = compare_landmarks_at(old.landmarks, new.landmarks, T, config)
        return replace(proposal, semantics=semantics)

    # --- its proof --------------------------------------------------------------------------------
    def verify(self, proposal: LoopHypothesis) -> VerificationResult:
        """Refine a pose on the images, and see whether the surfaces meet."""
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
        """A pose of landmarks as it is: what the paper's fine stage alone would close."""
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

    def _rejection_reason(
        self, proposal: LoopHypothesis, alignment: Alignment, fit: DepthConsistency, shared: float
    ) -> str:
        """What speaks against a pose; nothing: "". `shared`: of either's surface, at least."""
        config, by_landmarks = self._config, proposal.evidence == "landmarks"
        moved = se3.inverse(proposal.T_old_new) @ alignment.T_reference_camera
        limit = config.refined_landmarks_rad if by_landmarks else config.refined_rad
        if image_motion_rad(moved, _depth(proposal)) > limit:
            return "images and " + proposal.evidence + " disagree"
        if alignment.condition > config.max_condition:
            return "degenerate alignment"
        if abs(np.log(max(alignment.gain, 1e-6))) > np.log(config.max_gain):
            return f"brightness differs {alignment.gain:.2f} times"
        by_features = proposal.evidence == "features"
        if shared < (config.fit.min_overlap if by_features else config.blind_overlap):
            return f"overlap {shared:.2f}"
        if fit.rmse_m > config.fit.max_rmse_m:
            return f"surfaces are {100 * fit.rmse_m:.1f} cm apart"
        if fit.conflict > config.fit.max_conflict:
            return f"{fit.conflict:.0%} lies in free space"
        seen = proposal.semantics
        if seen.contradicted > max(config.max_contradictions, seen.count):
            return f"{seen.contradicted} other things stand there"
        return ""


def _likely_pairs(
    old: Subgraph, new: Subgraph
) -> Iterator[tuple[SubgraphKeyframe, SubgraphKeyframe]]:
    """All pairs of keyframes, those with most visual words in common first."""
    pairs = list(product(old.views, new.views))
    shared = [float(np.minimum(a.words, b.words).sum()) for a, b in pairs]
    return (pairs[index] for index in np.argsort(-np.array(shared), kind="stable"))


def _nearest_pairs(
    old: Subgraph, new: Subgraph, T_old_new: KnownPose
) -> Iterator[tuple[SubgraphKeyframe, SubgraphKeyframe, np.ndarray]]:
    """Each new keyframe with the old one that a pose brings nearest to it, the nearest first; with
    T_old_new [4, 4]."""
    nearest = []
    for b in new.views:
        known = [(a, b, T) for a in old.views if (T := T_old_new(a, b)) is not None]
        apart = [image_motion_rad(T, a.place.median_depth_m) for a, _, T in known]
        if known:
            index = int(np.argmin(apart))
            nearest.append((apart[index], known[index]))
    for index in np.argsort([apart for apart, _ in nearest], kind="stable"):
        yield nearest[index][1]


def _between(
    old: SubgraphKeyframe, new: SubgraphKeyframe, T_oldodom_newodom: np.ndarray
) -> np.ndarray:
    """T_old_new [4, 4]."""
    T_odom_old, T_odom_new = old.place.T_odom_keyframe, new.place.T_odom_keyframe
    return se3.orthonormalize(se3.inverse(T_odom_old) @ T_oldodom_newodom @ T_odom_new)


def _odometry_frames(proposal: LoopHypothesis) -> np.ndarray:
    """T_oldodom_newodom [4, 4] that a proposal says."""
    T_odom_old = proposal.old.place.T_odom_keyframe
    return T_odom_old @ proposal.T_old_new @ se3.inverse(proposal.new.place.T_odom_keyframe)


def _as_seen_by(best: LoopHypothesis, other: LoopHypothesis) -> np.ndarray:
    """T_old_new [4, 4] of the keyframes of `best`, as the other says it."""
    return _between(best.old, best.new, _odometry_frames(other))


def _depth(proposal: LoopHypothesis) -> float:
    return proposal.new.place.median_depth_m
