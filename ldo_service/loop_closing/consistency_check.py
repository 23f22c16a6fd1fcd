"""Checks of loop hypotheses against the map: plausible drift and perceptual aliasing.

Rooms with the same furniture look alike in images. The keyframe poses in the map distinguish such
rooms, because drift along the camera path is bounded.
Conventions: `ldo_service.geometry`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import KeyframePoses
from ldo_service.tracking.motion import image_motion_rad, image_motions_rad

from .subgraph import Subgraph, SubgraphKeyframe
from .verification import LoopHypothesis


@dataclass(frozen=True, slots=True)
class ConsistencyCheckConfig:
    """Limits of the drift and of the ambiguity of a loop hypothesis."""

    drift_m: float = 0.5  # Allowed position drift on any path.
    # Additional position drift in meters per meter of path; ten times that of depth cameras.
    drift: float = 0.1
    turn_rad: float = 0.35  # Allowed rotation drift on any path.
    turn_rad_per_m: float = 0.02  # Additional rotation drift per meter of path; 1.1 degrees.
    # Maximum pose difference of two cameras that see the same surfaces. view_rad is the
    # rotation, about the width of a view; view_depths is the distance in median depths. The allowed
    # drift is added to these limits.
    view_rad: float = 1.5
    view_depths: float = 2.0
    # A hypothesis is ambiguous if another one has at least this fraction of its inliers, and if the
    # two put the new keyframe at poses that differ by more than ambiguous_rad, rotation plus
    # parallax. 1 rad is a rotation by 57 degrees or a distance of one median depth.
    ambiguous_inlier_ratio: float = 0.5
    ambiguous_rad: float = 1.0

    def __post_init__(self) -> None:
        if (
            min(getattr(self, name) for name in self.__slots__) < 0
            or self.ambiguous_inlier_ratio > 1
        ):
            raise ConfigError(
                named(self, *self.__slots__)
                + ": each value must be at least 0, and ambiguous_inlier_ratio must be at most 1."
            )


class ConsistencyChecker:
    """Check of loop hypotheses against the known keyframe poses.

    A hypothesis between two submaps that are not merged is not checked, because the relative pose
    of the submaps is unknown.
    """

    def __init__(
        self, poses: KeyframePoses, merged: Mapping[int, int], config: ConsistencyCheckConfig
    ) -> None:
        """Create a checker.

        Args:
            poses: Keyframe poses in the map.
            merged: For each merged submap, the older submap that it is merged into.
            config: Limits.
        """
        self._poses, self._merged_submaps, self._config = poses, merged, config

    def possible_matches(
        self, old: Sequence[SubgraphKeyframe], new: SubgraphKeyframe
    ) -> np.ndarray:
        """Return which of S stored keyframes may show the same surfaces as a new one, [S] bool.

        A stored keyframe is excluded if its distance or its rotation from the new keyframe is too
        large. Each limit is the maximum drift plus the largest pose difference of two cameras that
        see the same surfaces (settings `view_depths` and `view_rad`). A stored keyframe is not
        excluded if its pose relative to the new keyframe is unknown.
        """
        if new.keyframe not in self._poses:
            return np.ones(len(old), bool)
        known = self._are_known(old, new.place.submap)
        may = ~known
        at = np.flatnonzero(known)
        views, config = [old[k] for k in at.tolist()], self._config
        T_new, T_old = self._poses[new.keyframe], self._poses.of([v.keyframe for v in views])
        way_m = np.abs(new.path_m - np.array([view.path_m for view in views]))
        depth_m = np.array([view.place.median_depth_m for view in views])
        reach_m = config.view_depths * np.maximum(depth_m, new.place.median_depth_m)
        gap_m = np.linalg.norm(T_old[:, :3, 3] - T_new[:3, 3], axis=1)
        cosine = (np.einsum("nij,ij->n", T_old[:, :3, :3], T_new[:3, :3]) - 1) / 2
        turn_rad = np.arccos(np.clip(cosine, -1, 1))
        may[at] = (gap_m <= config.drift_m + config.drift * way_m + reach_m) & (
            turn_rad <= config.turn_rad + config.turn_rad_per_m * way_m + config.view_rad
        )
        return may

    def image_motions(
        self,
        old: Sequence[Subgraph],
        new: Subgraph,
        is_possible: np.ndarray,
        min_gap_frames: int,
    ) -> np.ndarray:
        """Return the rotation plus parallax from each of S stored subgraphs to a new one, [S] rad.

        The value is the minimum over the pairs of a keyframe of the stored subgraph and a keyframe
        of the new one. Pairs that are at most `min_gap_frames` frames apart are left out.
        Otherwise, the subgraph before the new one would always be the nearest. The value is
        infinite if a subgraph is not compared, or if its pose relative to the new one is unknown.

        Args:
            old: Stored subgraphs.
            new: New subgraph.
            is_possible: True for the stored subgraphs to compare, [S] bool.
            min_gap_frames: Keyframes of a pair are more than this number of camera frames apart.
        """
        motions_rad = np.full(len(old), np.inf)
        at = [k for k in np.flatnonzero(is_possible).tolist() for _ in old[k].views]
        views = [view for k in np.flatnonzero(is_possible).tolist() for view in old[k].views]
        known = np.flatnonzero(self._are_known(views, new.submap))
        views = [views[k] for k in known.tolist()]
        new_views = [view for view in new.views if view.keyframe in self._poses]
        if views and new_views:
            T_old, T_new = (self._poses.of([v.keyframe for v in of]) for of in (views, new_views))
            depth_m = np.array([view.place.median_depth_m for view in views])
            apart_rad = image_motions_rad(se3.inverse(T_old)[:, None] @ T_new, depth_m[:, None])
            frames, new_frames = (np.array([v.frame for v in of]) for of in (views, new_views))
            apart_rad[np.abs(new_frames - frames[:, None]) <= min_gap_frames] = np.inf
            np.minimum.at(motions_rad, np.array(at)[known], apart_rad.min(axis=1))
        return motions_rad

    def _are_known(self, views: Sequence[SubgraphKeyframe], submap: int) -> np.ndarray:
        """Return which keyframes have a pose in the map that contains a submap, [n] bool."""
        root = self._root(submap)
        known = self._poses.are_known([view.keyframe for view in views])
        return known & np.array([self._root(view.place.submap) == root for view in views], bool)

    def check_drift(self, proposal: LoopHypothesis) -> LoopHypothesis:
        """Check a loop hypothesis, and return it with a `rejected_reason` if it is rejected.

        A hypothesis is rejected if it implies more drift than the length of the camera path allows.
        A hypothesis whose keyframes have no known relative pose is returned unchanged.
        """
        old, new = proposal.old, proposal.new
        if proposal.rejected_reason or not self._is_known(old, new):
            return proposal
        gap_m, turn_rad = self._drift(old, new, proposal.T_old_new)
        limit_m, limit_rad = self._limits(old, new)
        way_m = abs(new.path_m - old.path_m)
        if gap_m > limit_m:
            return replace(proposal, rejected_reason=f"{gap_m:.1f} m of drift after {way_m:.0f} m")
        if turn_rad > limit_rad:
            reason = f"{np.degrees(turn_rad):.0f} degrees of drift after {way_m:.0f} m"
            return replace(proposal, rejected_reason=reason)
        return proposal

    def reject_aliased(self, proposals: Sequence[LoopHypothesis]) -> list[LoopHypothesis]:
        """Return all hypotheses of a new subgraph; the ambiguous ones are marked as rejected.

        Hypothesis A is ambiguous if a hypothesis B fits nearly as well and gives the new keyframe
        another pose. B must have at least the fraction `ambiguous_inlier_ratio` of the inliers of
        A. The rotation plus parallax between the poses must exceed `ambiguous_rad`.
        """
        return [
            replace(proposal, rejected_reason="ambiguous: another place fits as well")
            if not proposal.rejected_reason
            and any(self._is_aliased(proposal, o) for o in proposals)
            else proposal
            for proposal in proposals
        ]

    def _is_aliased(self, proposal: LoopHypothesis, other: LoopHypothesis) -> bool:
        enough = self._config.ambiguous_inlier_ratio * proposal.inliers
        if other.rejected_reason or other.evidence != proposal.evidence or other.inliers < enough:
            return False
        if not self._is_known(proposal.old, other.old):
            return False
        T, T_other = (self._T_map(p, proposal.new) for p in (proposal, other))
        apart_rad = image_motion_rad(se3.inverse(T) @ T_other, proposal.new.place.median_depth_m)
        return apart_rad > self._config.ambiguous_rad

    def _T_map(self, proposal: LoopHypothesis, new: SubgraphKeyframe) -> np.ndarray:
        """Return the pose T_map_keyframe [4, 4] of keyframe `new` that a hypothesis implies."""
        T_new_odom = se3.inverse(proposal.new.place.T_odom_keyframe)
        T_map_newodom = self._poses[proposal.old.keyframe] @ proposal.T_old_new @ T_new_odom
        return T_map_newodom @ new.place.T_odom_keyframe

    def T_old_new(self, old: SubgraphKeyframe, new: SubgraphKeyframe) -> np.ndarray | None:
        """Return the relative pose [4, 4] of two keyframes in the map, or None if it is unknown."""
        if not self._is_known(old, new):
            return None
        return se3.inverse(self._poses[old.keyframe]) @ self._poses[new.keyframe]

    def _is_known(self, old: SubgraphKeyframe, new: SubgraphKeyframe) -> bool:
        """Return whether both keyframes have poses in the map and lie in merged submaps."""
        if old.keyframe not in self._poses or new.keyframe not in self._poses:
            return False
        return self._root(old.place.submap) == self._root(new.place.submap)

    def _root(self, submap: int) -> int:
        return self._merged_submaps.get(submap, submap)

    def _drift(
        self, old: SubgraphKeyframe, new: SubgraphKeyframe, T_old_new: np.ndarray
    ) -> tuple[float, float]:
        """Return by how much a measured relative pose differs from that in the map, m and rad."""
        T_map_new = self._poses[old.keyframe] @ T_old_new
        T_gap = se3.inverse(T_map_new) @ self._poses[new.keyframe]
        return float(np.linalg.norm(T_gap[:3, 3])), se3.rotation_angle(T_gap)

    def _limits(self, old: SubgraphKeyframe, new: SubgraphKeyframe) -> tuple[float, float]:
        """Return the maximum drift between two keyframes in m and rad."""
        way_m, config = abs(new.path_m - old.path_m), self._config
        return (
            config.drift_m + config.drift * way_m,
            config.turn_rad + config.turn_rad_per_m * way_m,
        )
