"""What the map says of a pose: how far odometry may have drifted, and whether a twin fits as well.

Rooms are furnished alike, and no image tells them apart; where the camera went does. Conventions:
`ldo_service.geometry`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import KeyframePoses
from ldo_service.tracking.motion import image_motion_rad

from .subgraph import SubgraphKeyframe
from .verification import LoopHypothesis


@dataclass(frozen=True, slots=True)
class ConsistencyCheckConfig:
    drift_m: float = 0.5  # that a loop may close in any case, and
    drift: float = 0.1  # m for each m of the way since: ten times what depth cameras drift
    turn_rad: float = 0.35  # likewise of the heading, and
    turn_rad_per_m: float = 0.02  # 1.1 degrees for each m
    view_rad: float = 1.5  # between cameras that see one place, beyond the drift: a view's width
    view_depths: float = 2.0  # median depths between them, likewise
    rival_inliers: float = 0.5  # of the best: a candidate with more that says
    rival_rad: float = 1.0  # the camera is this far elsewhere (57 degrees, or a median depth)

    def __post_init__(self) -> None:
        if min(getattr(self, name) for name in self.__slots__) < 0 or self.rival_inliers > 1:
            raise ConfigError(
                named(self, *self.__slots__)
                + ": each must be at least 0, and rival_inliers at most 1."
            )


class ConsistencyChecker:
    """Judges by poses of the keyframes that are known; `joined` are submaps, each with the older
    one whose frame it is in. Of two submaps that are apart nothing is known."""

    def __init__(
        self, poses: KeyframePoses, joined: Mapping[int, int], config: ConsistencyCheckConfig
    ) -> None:
        self._poses, self._joined, self._config = poses, joined, config

    def possible_matches(
        self, old: Sequence[SubgraphKeyframe], new: SubgraphKeyframe
    ) -> np.ndarray:
        """[S] bool: which of S views a keyframe may show again, wherever it looks: all but those
        that are farther or turned more than drift and the width of a view explain."""
        if new.keyframe not in self._poses:
            return np.ones(len(old), bool)
        root = self._root(new.place.submap)
        known = self._poses.are_known([view.keyframe for view in old])
        known &= np.array([self._root(view.place.submap) == root for view in old], bool)
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

    def check_drift(self, proposal: LoopHypothesis) -> LoopHypothesis:
        """Refused where no drift since then explains it."""
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
        """Those refused whose view another place far elsewhere explains nearly as well."""
        return [
            replace(proposal, rejected_reason="ambiguous: another place fits as well")
            if not proposal.rejected_reason
            and any(self._is_aliased(proposal, o) for o in proposals)
            else proposal
            for proposal in proposals
        ]

    def _is_aliased(self, proposal: LoopHypothesis, other: LoopHypothesis) -> bool:
        enough = self._config.rival_inliers * proposal.inliers
        if other.rejected_reason or other.evidence != proposal.evidence or other.inliers < enough:
            return False
        if not self._is_known(proposal.old, other.old):
            return False
        T, T_other = (self._T_map(p, proposal.new) for p in (proposal, other))
        apart_rad = image_motion_rad(se3.inverse(T) @ T_other, proposal.new.place.median_depth_m)
        return apart_rad > self._config.rival_rad

    def _T_map(self, proposal: LoopHypothesis, new: SubgraphKeyframe) -> np.ndarray:
        """Where a keyframe of the new subgraph is [4, 4], as a proposal says."""
        T_new_odom = se3.inverse(proposal.new.place.T_odom_keyframe)
        T_map_newodom = self._poses[proposal.old.keyframe] @ proposal.T_old_new @ T_new_odom
        return T_map_newodom @ new.place.T_odom_keyframe

    def T_old_new(self, old: SubgraphKeyframe, new: SubgraphKeyframe) -> np.ndarray | None:
        """[4, 4] as the map has them; None where it does not say."""
        if not self._is_known(old, new):
            return None
        return se3.inverse(self._poses[old.keyframe]) @ self._poses[new.keyframe]

    def _is_known(self, old: SubgraphKeyframe, new: SubgraphKeyframe) -> bool:
        """Whether the map says where both are to each other."""
        if old.keyframe not in self._poses or new.keyframe not in self._poses:
            return False
        return self._root(old.place.submap) == self._root(new.place.submap)

    def _root(self, submap: int) -> int:
        return self._joined.get(submap, submap)

    def _drift(
        self, old: SubgraphKeyframe, new: SubgraphKeyframe, T_old_new: np.ndarray
    ) -> tuple[float, float]:
        """m and rad between where a pose and the map have the new keyframe."""
        T_map_new = self._poses[old.keyframe] @ T_old_new
        T_gap = se3.inverse(T_map_new) @ self._poses[new.keyframe]
        return float(np.linalg.norm(T_gap[:3, 3])), se3.rotation_angle(T_gap)

    def _limits(self, old: SubgraphKeyframe, new: SubgraphKeyframe) -> tuple[float, float]:
        """m and rad of drift between them."""
        way_m, config = abs(new.path_m - old.path_m), self._config
        return (
            config.drift_m + config.drift * way_m,
            config.turn_rad + config.turn_rad_per_m * way_m,
        )
