"""Loop detector: groups keyframes into subgraphs and finds earlier subgraphs of the same place.

Conventions: `ldo_service.geometry`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import KeyframePoses, RelativePose
from ldo_service.tracking.alignment import AlignConfig
from ldo_service.tracking.features import FeatureConfig
from ldo_service.tracking.keyframe_database import KeyframeDatabaseConfig, KeyframeRecord
from ldo_service.tracking.pyramid import PyramidConfig

from .consistency_check import ConsistencyCheckConfig, ConsistencyChecker
from .object_points import DetectionPoints, cluster_landmarks, layout_histogram
from .object_presence import MapLandmarks, ObjectPresenceChecker
from .place_database import PlaceDatabase, RetrievalConfig, RetrievalMatch, Stages
from .subgraph import (
    Subgraph,
    SubgraphConfig,
    SubgraphKeyframe,
    evenly_spaced,
    follows,
    is_complete,
)
from .verification import LoopHypothesis, VerificationConfig, VerificationResult, Verifier
from .visual_words import VisualWords, VisualWordsConfig

# Minimum feature inliers of a pose between two keyframes. The tracker requires 15. Here 12 suffice,
# because surfaces and the pose graph also verify a loop closure.
LOOP_MIN_INLIERS = 12


@dataclass(frozen=True, slots=True)
class LoopsConfig:
    """Parameters of loop detection."""

    # Data that the coarse and the fine step use. two_stage: labels and images find candidates, and
    # surfaces verify poses from features, landmarks or the map. If there is a map, its objects
    # verify them too. The other values are for comparison. geometric: no labels; semantic: no
    # images, only landmarks as in the LDO-SLAM paper, III.C.
    stages: Stages = "two_stage"
    subgraphs: SubgraphConfig = field(default_factory=SubgraphConfig)
    words: VisualWordsConfig = field(default_factory=VisualWordsConfig)
    retrieval: RetrievalConfig = field(default_factory=RetrievalConfig)
    verification: VerificationConfig = field(default_factory=VerificationConfig)
    plausibility: ConsistencyCheckConfig = field(default_factory=ConsistencyCheckConfig)
    keyframe_database: KeyframeDatabaseConfig = field(default_factory=KeyframeDatabaseConfig)
    pyramid: PyramidConfig = field(default_factory=PyramidConfig)
    features: FeatureConfig = field(
        default_factory=lambda: FeatureConfig(min_inliers=LOOP_MIN_INLIERS)
    )
    align: AlignConfig = field(default_factory=AlignConfig)

    def __post_init__(self) -> None:
        if self.stages not in ("two_stage", "semantic", "geometric"):
            raise ConfigError(
                f"{named(self, 'stages')} must be 'two_stage', 'semantic' or 'geometric'."
            )


@dataclass(frozen=True, eq=False, slots=True)
class LoopCandidateResult:
    """Loop candidate: new subgraph, similar stored subgraph, and result of the verification."""

    new: Subgraph
    match: RetrievalMatch
    check: VerificationResult

    @property
    def closure(self) -> RelativePose | None:
        """The verified loop closure, or None if the candidate was rejected."""
        return self.check.closure


class LoopDetector:
    """Detector that groups keyframes into subgraphs and compares each with earlier subgraphs."""

    def __init__(self, config: LoopsConfig) -> None:
        """Start with an empty place database."""
        self._config = config
        self._words = VisualWords(config.words)
        self._memory = PlaceDatabase(config.words.count, config.stages, config.retrieval)
        self._open: list[SubgraphKeyframe] = []  # Keyframes of the unfinished subgraph.
        self._path_m = 0.0
        self._last: tuple[int, np.ndarray] | None = None  # Submap and T_odom_keyframe.
        self._verifier = Verifier(
            config.pyramid,
            config.align,
            config.features,
            config.verification,
            config.retrieval.exclude_frames,
        )
        self._presence = ObjectPresenceChecker()

    @property
    def subgraphs(self) -> Sequence[Subgraph]:
        """Stored subgraphs, in the order of their keyframes."""
        return self._memory.subgraphs

    @property
    def is_open(self) -> bool:
        """True if there is an unfinished subgraph."""
        return bool(self._open)

    @property
    def can_flush(self) -> bool:
        """True if the unfinished subgraph is long enough to be compared."""
        return len(self._open) >= self._config.subgraphs.min_keyframes

    def add(
        self,
        place: KeyframeRecord,
        frame: int,
        stamp_ns: int,
        sightings: DetectionPoints | None,
        poses: KeyframePoses,
        merged: Mapping[int, int],
        objects: MapLandmarks | None = None,
    ) -> list[LoopCandidateResult]:
        """Add a keyframe; return the loop candidates of the subgraph that it completes, if any.

        Args:
            place: Record of the keyframe, without pixels of dynamic classes.
            frame: Frame number of the camera.
            stamp_ns: Stamp of the keyframe.
            sightings: Detections as labelled 3D points; None if no detector ran.
            poses: T_map_keyframe of the stored keyframes. Loops of keyframes without a pose are not
                checked for plausible drift.
            merged: For each merged submap, the older submap that it is merged into.
            objects: Objects of the map, used if the setting `stages` is two_stage; None if there is
                no map.
        """
        results: list[LoopCandidateResult] = []
        if self._open and not follows(self._open[-1].place, place, self._config.subgraphs):
            results = self.flush(poses, merged, objects)
            self._open = []
        self._open.append(self._view(place, frame, stamp_ns, sightings))
        if is_complete(self._open, self._config.subgraphs):
            results += self._completed(poses, merged, objects)
        return results

    def flush(
        self,
        poses: KeyframePoses,
        merged: Mapping[int, int],
        objects: MapLandmarks | None = None,
    ) -> list[LoopCandidateResult]:
        """Complete the unfinished subgraph if it is long enough, and return its loop candidates.

        Call this when no further keyframe follows: at the end of a run and after a loss of
        tracking. Loops are likely at these times. A run often ends where it began. After a loss,
        the newest keyframes are near the place where tracking was lost.
        """
        if not self.can_flush:
            return []
        return self._completed(poses, merged, objects)

    def _completed(
        self, poses: KeyframePoses, merged: Mapping[int, int], objects: MapLandmarks | None
    ) -> list[LoopCandidateResult]:
        new, self._open = self._subgraph(self._open), []
        results = self._findings(new, poses, merged, objects)
        kept = evenly_spaced(new.views, self._config.subgraphs.kept_views)
        self._memory.add(replace(new, views=kept))
        return results

    # --- subgraphs --------------------------------------------------------------------------------
    def _view(
        self, place: KeyframeRecord, frame: int, stamp_ns: int, sightings: DetectionPoints | None
    ) -> SubgraphKeyframe:
        self._path_m += self._step_m(place)
        self._last = place.submap, place.T_odom_keyframe
        self._words.learn(place.descriptors)
        words = self._words.histogram(place.descriptors)
        has_detections = sightings is not None
        sightings = sightings if has_detections and self._config.stages != "geometric" else None
        sightings = sightings or DetectionPoints.none()
        return SubgraphKeyframe(
            place, frame, stamp_ns, self._path_m, has_detections, sightings, words
        )

    def _step_m(self, place: KeyframeRecord) -> float:
        """Return the distance of a keyframe from the previous keyframe in meters.

        The distance is unknown at the start of a submap, where the result is 0.
        """
        if self._last is None or self._last[0] != place.submap:
            return 0.0
        return float(np.linalg.norm(place.T_odom_keyframe[:3, 3] - self._last[1][:3, 3]))

    def _subgraph(self, views: list[SubgraphKeyframe]) -> Subgraph:
        seen = [view.sightings for view in views]
        T_odom = [view.place.T_odom_keyframe for view in views]
        landmarks = cluster_landmarks(seen, T_odom, self._config.verification.landmarks)
        return Subgraph(
            views=tuple(views),
            keyframes=tuple(view.keyframe for view in views),
            first_frame=min(view.frame for view in views),
            last_frame=max(view.frame for view in views),
            stamp_ns=views[-1].stamp_ns,
            path_m=views[-1].path_m,
            has_detections=any(view.has_detections for view in views),
            landmarks=landmarks,
            names=np.sum([sightings.histogram() for sightings in seen], axis=0),
            layout=layout_histogram(landmarks),
            words=np.sum([view.words for view in views], axis=0),
        )

    # --- loops ------------------------------------------------------------------------------------
    def _findings(
        self,
        new: Subgraph,
        poses: KeyframePoses,
        merged: Mapping[int, int],
        objects: MapLandmarks | None,
    ) -> list[LoopCandidateResult]:
        """Return all loop candidates of a new subgraph, with the results of their verification.

        All similar subgraphs are verified. Those that fail make no other candidate ambiguous. Of
        those that pass, the one with the most inliers becomes the loop closure; the others are
        rejected. The nearest subgraph in the map is verified if no similar one passes.
        """
        known = ConsistencyChecker(poses, merged, self._config.plausibility)
        is_possible = known.possible_matches(
            [old.views[0] for old in self.subgraphs], new.views[-1]
        )
        motion_rad = known.image_motions(
            self.subgraphs, new, is_possible, self._config.retrieval.exclude_frames
        )
        likely = self._memory.query(new, is_possible, motion_rad)
        checks: list[VerificationResult] = []
        for like in likely:
            if like.is_near and any(check.closure for check in checks):
                break
            proposal = known.check_drift(self._proposal(like.subgraph, new, known))
            check = self._check(proposal)
            if check.closure and objects and self._config.stages == "two_stage":
                check = self._check_objects(
                    check, check.closure, like.subgraph, new, poses, objects
                )
            checks.append(check)
        proposals = known.reject_aliased([_with_reason(check) for check in checks])
        checks = [
            _rejected(check, proposal.rejected_reason)
            for check, proposal in zip(checks, proposals, strict=True)
        ]
        passed = [k for k, check in enumerate(checks) if check.closure]
        best = max(passed, key=lambda k: checks[k].proposal.inliers, default=None)
        return [
            LoopCandidateResult(
                new,
                like,
                check if k == best else _rejected(check, "another candidate closed the loop"),
            )
            for k, (like, check) in enumerate(zip(likely, checks, strict=False))
        ]

    def _proposal(self, old: Subgraph, new: Subgraph, known: ConsistencyChecker) -> LoopHypothesis:
        """Return the loop hypothesis of a candidate; it is marked as rejected if no pose is found.

        The methods are tried in the order features, landmarks, map. Poses from features are
        accurate to centimeters, and poses from landmarks to decimeters. Poses from the map come
        last, because two new keyframes must confirm them.
        """
        verifier, stages = self._verifier, self._config.stages
        if stages == "semantic":
            return verifier.hypothesis_from_landmarks(old, new)
        proposal = verifier.hypothesis_from_features(old, new)
        if proposal.rejected_reason and stages == "two_stage":
            proposal = _unless_refused(verifier.hypothesis_from_landmarks(old, new), proposal)
        if proposal.rejected_reason:
            proposal = _unless_refused(
                verifier.hypothesis_from_map(old, new, known.T_old_new), proposal
            )
        return proposal

    def _check(self, proposal: LoopHypothesis) -> VerificationResult:
        if proposal.rejected_reason:
            return VerificationResult(proposal, rejected_reason=proposal.rejected_reason)
        if self._config.stages == "semantic":
            return self._verifier.accept_unverified(proposal)
        return self._verifier.verify(proposal)

    def _check_objects(
        self,
        check: VerificationResult,
        closure: RelativePose,
        old: Subgraph,
        new: Subgraph,
        poses: KeyframePoses,
        objects: MapLandmarks,
    ) -> VerificationResult:
        """Return a verified hypothesis, rejected if objects of the map contradict it."""
        if closure.a not in poses or closure.b not in poses:
            return check
        T_there_new = poses[closure.a] @ closure.T_a_b @ se3.inverse(poses[closure.b])
        found = self._presence.check(objects, old, new, T_there_new, poses)
        reason = (
            f"{found.missing} objects are missing and {found.replaced} replaced, "
            f"in {found.tested} tests"
        )
        return _rejected(check, reason if found.contradicts else "")

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, Any]:
        """Return the state for a checkpoint.

        The entries of the lists `subgraphs` and `views` are never modified later.
        """
        return {
            "subgraphs": [subgraph.pack() for subgraph in self._memory.subgraphs],
            "views": [view.pack() for view in self._open],
            "words": self._words.words,
            "path": (self._path_m, self._last),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Replace the state by that of a snapshot."""
        self.__init__(self._config)
        for packed in state["subgraphs"]:
            self._memory.add(Subgraph.unpack(packed))
        self._open = [SubgraphKeyframe.unpack(packed) for packed in state["views"]]
        self._words = VisualWords(self._config.words, state["words"])
        self._path_m, last = state["path"]
        self._last = None if last is None else (last[0], last[1])


def _rejected(check: VerificationResult, reason: str) -> VerificationResult:
    """Return the result rejected for a reason, unless it is rejected already or there is none."""
    if check.rejected_reason or not reason:
        return check
    return replace(check, rejected_reason=reason, closure=None)


def _with_reason(check: VerificationResult) -> LoopHypothesis:
    """Return the hypothesis of a result, rejected for the reason of the result."""
    return replace(check.proposal, rejected_reason=check.rejected_reason)


def _unless_refused(proposal: LoopHypothesis, other: LoopHypothesis) -> LoopHypothesis:
    return other if proposal.rejected_reason else proposal
