"""All that is known of keyframes and landmarks, and the factors that say it."""

from collections.abc import Callable, Iterable, Mapping, Set
from typing import Any

import gtsam
import numpy as np

from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import RelativePose

from .condensation import (
    CondensedKeyframes,
    condense,
    connecting_measurements,
    transfer_measurement,
)
from .factors import (
    BoxObservation,
    NoiseConfig,
    between_factor,
    box_factor,
    closure_information,
    closure_residual,
    odometry_information,
    pack_relative,
    pack_sights,
    prior_factor,
    unpack_relative,
    unpack_sights,
)
from .loop_closures import LoopClosureConfig, LoopClosureSet, Pair, pair_of
from .solver import Name, Variables, point_key


class FactorStore:
    """Between keyframes that are variables, and others that follow two of them: what is measured of
    a follower is measured of the nearer one."""

    def __init__(self, noise: NoiseConfig, closures: LoopClosureConfig) -> None:
        self._noise = noise
        self.first_of: dict[int, int] = {}  # the first keyframe of each one's component
        self.active: list[int] = []  # variables that are not condensed, ascending
        self.odometry: dict[Pair, RelativePose] = {}  # between variables
        self.condensed: dict[Pair, RelativePose] = {}  # heads, each in the one before
        self.joins: dict[Pair, RelativePose] = {}  # between what were components
        self.closures = LoopClosureSet(closures)
        self.doubts: dict[Pair, RelativePose] = {}  # closures that contradict a join, the newest
        self.sights: dict[Pair, BoxObservation] = {}  # by keyframe and landmark
        self.followers = CondensedKeyframes.none()
        self.rows: dict[int, int] = {}  # of followers

    # --- what changes -----------------------------------------------------------------------------
    def add_measurement(self, m: RelativePose) -> Name:
        """The factor's name; in place of what was measured between the same variables, but what is
        measured of followers in place of nothing that is."""
        between = self.between_variables(m)
        pair = between.a, between.b
        if between is m or pair not in self.odometry:
            self.odometry[pair] = between
        return ("odometry", *pair)

    def replace_measurement(
        self, m: RelativePose, pose: Callable[[int], np.ndarray]
    ) -> Name | None:
        """The name of the factor that is another one now; of a follower, which is placed where it
        was measured, there is none. `pose` tells T_map_keyframe [4, 4]."""
        row = self.rows.get(m.b)
        if row is not None:
            self.followers = self.followers.moved(row, self._in_head_of_b(m, pose))
            return None
        if (m.a, m.b) in self.joins:
            self.joins[m.a, m.b] = m
            return ("join", m.a, m.b)
        between = self.between_variables(m)
        pair = between.a, between.b
        if pair not in self.condensed:
            return self.add_measurement(between)
        own = self.condensed[pair].information
        self.condensed[pair] = RelativePose(*pair, between.T_a_b, own)
        return ("condensed", *pair)

    def _in_head_of_b(self, m: RelativePose, pose: Callable[[int], np.ndarray]) -> np.ndarray:
        (head_a, T_a), (head_b, _) = self.relative_to_start(m.a), self.relative_to_start(m.b)
        if head_a == head_b:
            return T_a @ m.T_a_b
        return se3.inverse(pose(head_b)) @ pose(m.a) @ m.T_a_b

    def condense(self, group: list[int], T_map: Mapping[int, np.ndarray]) -> None:
        """All of a group but its head and tail follow from now on.

        What was measured within it, closures too, is in the edge from head to tail. Later
        keyframes that were measured against followers are measured against later ones too, and
        that is given up, but where nothing else would hold them.
        """
        followers = set(group[1:-1])
        closed = {
            pair: closure
            for pair, closure in self.closures.accepted.items()
            if set(pair) <= set(group) and followers.intersection(pair)
        }
        one = condense(group, self.odometry, closed.values(), T_map, self._noise)
        self.closures = self.closures.without(closed)
        gone = [self.odometry.pop(p) for p in list(self.odometry) if followers.intersection(p)]
        self.odometry.pop((group[0], group[-1]), None)
        self.condensed[one.edge.a, one.edge.b] = one.edge
        self.followers = self.followers.joined_by(one.followers)
        self.rows = self.followers.index()
        self.active = [k for k in self.active if k not in group[:-1]]
        outside = [self.between_variables(m) for m in gone if not {m.a, m.b} <= set(group)]
        for m in connecting_measurements(outside, [(m.a, m.b) for m in self.relative()]):
            self.add_measurement(m)

    def restore_variable(self, keyframe: int) -> None:
        """Make a follower a variable again, between the two that it lies between: what is known
        from one to the other is spread over both parts, each by its share."""
        row = self.rows[keyframe]
        head, tail = (
            int(self.followers.start_variables[row]),
            int(self.followers.end_variables[row]),
        )
        share, T_head = float(self.followers.fractions[row]), self.followers.T_head[row]
        edge = self.condensed.pop((head, tail))
        T_tail = se3.inverse(T_head) @ edge.T_a_b
        covariance, adjoint = np.linalg.inv(edge.information), se3.adjoint(T_tail)
        before = np.linalg.inv(share * adjoint @ covariance @ adjoint.T)
        behind = edge.information / (1 - share)
        self.condensed[head, keyframe] = RelativePose(head, keyframe, T_head, before)
        self.condensed[keyframe, tail] = RelativePose(keyframe, tail, T_tail, behind)
        self.followers = self.followers.without_split(row)
        self.rows = self.followers.index()

    def interpolation_error_sigmas(self, keyframe: int, variables: Variables) -> float:
        """How far apart the two ends say that a follower is, in sigmas of a closure; 0 of a
        variable."""
        row = self.rows.get(keyframe)
        if row is None:
            return 0.0
        follower = self.followers.only(row)
        T_head, T_tail = (
            variables[int(follower.start_variables[0])],
            variables[int(follower.end_variables[0])],
        )
        by_head, by_tail = T_head @ follower.T_head[0], T_tail @ follower.T_tail[0]
        off, share = np.abs(se3.log(se3.inverse(by_head) @ by_tail)), float(follower.fractions[0])
        sigmas = np.repeat([self._noise.sigma_loop_rad, self._noise.sigma_loop_m], 3)
        return min(share, 1 - share) * float((off / sigmas).max())

    def relative(self, without: Pair | None = None) -> Iterable[RelativePose]:
        """All that holds variables together for good, or all but one join."""
        yield from self.odometry.values()
        yield from self.condensed.values()
        joins = (m for pair, m in self.joins.items() if pair != without)
        yield from map(self.between_variables, joins)

    # --- followers --------------------------------------------------------------------------------
    def relative_to_start(self, keyframe: int) -> tuple[int, np.ndarray]:
        """The first of its group, or itself, and T_head_keyframe [4, 4]."""
        row = self.rows.get(keyframe)
        if row is None:
            return keyframe, np.eye(4)
        return int(self.followers.start_variables[row]), self.followers.T_head[row]

    def relative_to_variable(self, keyframe: int) -> tuple[int, np.ndarray]:
        """The variable that stands for a keyframe, the nearer of the two that it lies between, and
        T_variable_keyframe [4, 4]."""
        row = self.rows.get(keyframe)
        if row is None or self.followers.fractions[row] <= 0.5:
            return self.relative_to_start(keyframe)
        return int(self.followers.end_variables[row]), self.followers.T_tail[row]

    def ends(self, m: RelativePose) -> tuple[tuple[int, np.ndarray], tuple[int, np.ndarray]]:
        """The variables that stand for both: another one where that would be the same."""
        a, b = self.relative_to_variable(m.a), self.relative_to_variable(m.b)
        return (
            (a, b) if a[0] != b[0] else (self.relative_to_start(m.a), self.relative_to_start(m.b))
        )

    def between_variables(self, m: RelativePose) -> RelativePose:
        (a, T_a), (b, T_b) = self.ends(m)
        if (a, b) == (m.a, m.b):
            return m
        return transfer_measurement(m, se3.inverse(T_a), se3.inverse(T_b), (a, b))

    def _ends_covariance(self, m: RelativePose) -> np.ndarray:
        """[6, 6] at b, of followers among its ends: their share of what their group is known by,
        as far as they are from the variable that stands for them."""
        total = np.zeros((6, 6))
        T_b_end = se3.inverse(m.T_a_b), np.eye(4)
        for keyframe, (variable, _), T in zip((m.a, m.b), self.ends(m), T_b_end, strict=True):
            if (row := self.rows.get(keyframe)) is None:
                continue
            pair = int(self.followers.start_variables[row]), int(self.followers.end_variables[row])
            share = self.followers.fractions[row]
            away = share if variable == pair[0] else 1 - share
            adjoint = se3.adjoint(T @ se3.inverse(self.followers.T_tail[row]))  # of T_b_tail
            covariance = np.linalg.inv(self.condensed[pair].information)
            total += away * adjoint @ covariance @ adjoint.T
        return total

    # --- factors ----------------------------------------------------------------------------------
    def names(self) -> Iterable[Name]:
        """Of all factors, in a fixed order."""
        yield from (("first", k) for k, first in self.first_of.items() if k == first)
        for kind in ("odometry", "condensed", "joins"):
            yield from ((kind.removesuffix("s"), *pair) for pair in getattr(self, kind))
        yield from (("closure", *pair) for pair in self.closures.accepted)
        yield from (("sight", *pair) for pair in self.sights)

    def factor(self, name: Name, initial: Variables) -> gtsam.NonlinearFactor:
        kind, pair = name[0], name[1:]
        match kind:
            case "first":
                return prior_factor(name[1], initial[name[1]], self._noise.first_sigma)
            case "odometry":
                return self._odometry_factor(self.odometry[pair])
            case "condensed":
                m = self.condensed[pair]
                return between_factor(m.a, m.b, m.T_a_b, m.information)
            case "join":
                return self._odometry_factor(self.between_variables(self.joins[pair]))
            case "closure":
                return self._closure_factor(self.closures.accepted[pair], self._noise.robust_sigmas)
        sight = self.sights[pair]
        return box_factor(sight, *self.relative_to_variable(sight.keyframe), self._noise)

    def with_closures(
        self, closures: Iterable[RelativePose], initial: Variables
    ) -> list[gtsam.NonlinearFactor]:
        """All factors, but of closures these, without a robust kernel: what they cost is
        compared."""
        others = [self.factor(name, initial) for name in self.names() if name[0] != "closure"]
        return [*others, *(self._closure_factor(closure, 0.0) for closure in closures)]

    def closure_sigmas(self, variables: Variables, closure: RelativePose) -> float:
        """The largest of its six whitened residuals."""
        m = self._closure(closure)
        residual = closure_residual(variables[m.a], variables[m.b], m)
        return float(np.abs(np.linalg.cholesky(m.information).T @ residual).max())

    def _odometry_factor(self, m: RelativePose) -> gtsam.NonlinearFactor:
        return between_factor(m.a, m.b, m.T_a_b, odometry_information(m, self._noise))

    def _closure_factor(self, closure: RelativePose, robust_sigmas: float) -> gtsam.NonlinearFactor:
        m = self._closure(closure)
        return between_factor(m.a, m.b, m.T_a_b, m.information, robust_sigmas)

    def _closure(self, m: RelativePose) -> RelativePose:
        """Between variables, as much as it is believed."""
        own = closure_information(m, self._noise, self._ends_covariance(m))
        return self.between_variables(RelativePose(m.a, m.b, m.T_a_b, own))

    # --- components -------------------------------------------------------------------------------
    def move_component(
        self, younger: int, older: int, T_new_old: np.ndarray, variables: Variables
    ) -> Variables:
        """All of a component into another: its variables and its landmarks."""
        theirs = {k for k, first in self.first_of.items() if first == younger}
        self.first_of.update(dict.fromkeys(theirs, older))
        return self.moved(theirs, T_new_old, variables)

    def moved(self, theirs: Set[int], T_new_old: np.ndarray, variables: Variables) -> Variables:
        """With some keyframes, and the landmarks in their images, elsewhere."""
        points = {point_key(s.landmark) for s in self.sights.values() if s.keyframe in theirs}
        moved = {k: T_new_old @ variables[k] for k in variables.keys() & theirs}
        moved |= {k: se3.transform(T_new_old, variables[k]) for k in variables.keys() & points}
        return {k: moved.get(k, value) for k, value in variables.items()}

    def keep_rejected(self, closure: RelativePose) -> None:
        """Keep what contradicts a join."""
        doubts = {**self.doubts, pair_of(closure): closure}
        self.doubts = dict(list(doubts.items())[-self.closures.config.doubts :])

    # --- state ------------------------------------------------------------------------------------
    def pack(self) -> dict[str, Any]:
        return {
            "keyframes": np.array(list(self.first_of), np.int64),
            "first_of": np.array(list(self.first_of.values()), np.int64),
            "active": np.array(self.active, np.int64),
            "odometry": pack_relative(self.odometry.values()),
            "condensed": pack_relative(self.condensed.values()),
            "joins": pack_relative(self.joins.values()),
            "doubts": pack_relative(self.doubts.values()),
            "closures": self.closures.pack(),
            "sights": pack_sights(self.sights.values()),
            "followers": self.followers.pack(),
        }

    def unpack(self, packed: Mapping[str, Any]) -> None:
        keyframes = packed["keyframes"].tolist()
        self.first_of = dict(zip(keyframes, packed["first_of"].tolist(), strict=True))
        self.active = packed["active"].tolist()
        for name in ("odometry", "condensed", "joins", "doubts"):
            setattr(self, name, {(m.a, m.b): m for m in unpack_relative(packed[name])})
        self.closures = LoopClosureSet.unpack(self.closures.config, packed["closures"])
        self.sights = {(s.keyframe, s.landmark): s for s in unpack_sights(packed["sights"])}
        self.followers = CondensedKeyframes(**packed["followers"])
        self.rows = self.followers.index()
