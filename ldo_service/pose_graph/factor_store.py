"""Store of all measurements of keyframes and landmarks, and construction of their factors."""

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
    pack_observations,
    pack_relative,
    prior_factor,
    unpack_observations,
    unpack_relative,
)
from .loop_closures import LoopClosureConfig, LoopClosureSet, Pair, pair_of
from .solver import Name, Variables, point_key


class FactorStore:
    """Store of all measurements by kind; it builds the factors of the pose graph.

    A factor connects variables, and a condensed keyframe is not a variable. In its measurements,
    the keyframe is therefore replaced by its head (the last variable before it) or its tail (the
    first variable after it), whichever is nearer.
    """

    def __init__(self, noise: NoiseConfig, closures: LoopClosureConfig) -> None:
        """Create an empty store."""
        self._noise = noise
        self.first_of: dict[int, int] = {}  # First keyframe of each keyframe's component.
        # Keyframes that may still be condensed, ascending: neither condensed nor head of a group.
        self.active: list[int] = []
        # Odometry measurements by pair of variables, converted ones included.
        self.odometry: dict[Pair, RelativePose] = {}
        # Measurements that replace groups, each from the head of a group to its tail.
        self.condensed: dict[Pair, RelativePose] = {}
        self.bridges: dict[Pair, RelativePose] = {}  # Bridge edges between merged components.
        self.closures = LoopClosureSet(closures)
        # Newest rejected closures that contradict a bridge edge, at most `max_contradicting`.
        self.contradicting: dict[Pair, RelativePose] = {}
        self.observations: dict[Pair, BoxObservation] = {}  # Observations by keyframe and landmark.
        self.interpolated = CondensedKeyframes.none()
        self.rows: dict[int, int] = {}  # Row of each condensed keyframe in `interpolated`.

    # --- changes ----------------------------------------------------------------------------------
    def add_measurement(self, m: RelativePose) -> Name:
        """Store an odometry measurement and return the name of its factor.

        If both keyframes are variables, the measurement replaces an older one of the same pair.
        Otherwise, `between_variables` converts the new measurement to one between two variables. It
        is stored only if these variables have no odometry measurement yet.
        """
        between = self.between_variables(m)
        pair = between.a, between.b
        if between is m or pair not in self.odometry:
            self.odometry[pair] = between
        return ("odometry", *pair)

    def replace_measurement(
        self, m: RelativePose, pose: Callable[[int], np.ndarray]
    ) -> Name | None:
        """Replace a measurement and return the name of the factor that changed.

        If keyframe b of the measurement is condensed, only the pose of b relative to the variables
        before and after b changes. No factor changes in this case, and None is returned.

        Args:
            m: New measurement.
            pose: Function that returns the current T_map_keyframe [4, 4] of a keyframe.
        """
        row = self.rows.get(m.b)
        if row is not None:
            self.interpolated = self.interpolated.moved(row, self._in_head_of_b(m, pose))
            return None
        if (m.a, m.b) in self.bridges:
            self.bridges[m.a, m.b] = m
            return ("join", m.a, m.b)
        between = self.between_variables(m)
        pair = between.a, between.b
        if pair not in self.condensed:
            return self.add_measurement(between)
        own = self.condensed[pair].information
        self.condensed[pair] = RelativePose(*pair, between.T_a_b, own)
        return ("condensed", *pair)

    def _in_head_of_b(self, m: RelativePose, pose: Callable[[int], np.ndarray]) -> np.ndarray:
        """Return T_head_b [4, 4] from a measurement of keyframe b relative to keyframe a.

        If a and b have different heads, the current poses in the map relate a to the head of b.
        """
        (head_a, T_a), (head_b, _) = self.relative_to_start(m.a), self.relative_to_start(m.b)
        if head_a == head_b:
            return T_a @ m.T_a_b
        return se3.inverse(pose(head_b)) @ pose(m.a) @ m.T_a_b

    def condense(self, group: list[int], T_map: Mapping[int, np.ndarray]) -> None:
        """Condense a group of keyframes: only the first and the last one remain variables.

        One measurement from the first to the last keyframe replaces all measurements and closures
        within the group. A measurement between a condensed keyframe and a keyframe outside the
        group is dropped, unless it is needed to keep the graph connected. In this case, it is
        converted by `between_variables`.

        Args:
            group: Ids of the keyframes, in order.
            T_map: Current poses T_map_keyframe [4, 4] of the group.
        """
        interpolated = set(group[1:-1])
        closed = {
            pair: closure
            for pair, closure in self.closures.accepted.items()
            if set(pair) <= set(group) and interpolated.intersection(pair)
        }
        one = condense(group, self.odometry, closed.values(), T_map, self._noise)
        self.closures = self.closures.without(closed)
        gone = [self.odometry.pop(p) for p in list(self.odometry) if interpolated.intersection(p)]
        self.odometry.pop((group[0], group[-1]), None)
        self.condensed[one.edge.a, one.edge.b] = one.edge
        self.interpolated = self.interpolated.merged_with(one.interpolated)
        self.rows = self.interpolated.index()
        self.active = [k for k in self.active if k not in group[:-1]]
        outside = [self.between_variables(m) for m in gone if not {m.a, m.b} <= set(group)]
        for m in connecting_measurements(outside, [(m.a, m.b) for m in self.relative()]):
            self.add_measurement(m)

    def restore_variable(self, keyframe: int) -> None:
        """Make a condensed keyframe a variable again.

        Before the call, one measurement connects the variables before and after the keyframe. Two
        new measurements replace it: one to the keyframe, one from the keyframe. The new ones share
        the covariance of the old one in proportion to `CondensedKeyframes.fractions`.
        """
        row = self.rows[keyframe]
        head, tail = self.interpolated.head_and_tail(row)
        share, T_head = float(self.interpolated.fractions[row]), self.interpolated.T_head[row]
        edge = self.condensed.pop((head, tail))
        T_tail = se3.inverse(T_head) @ edge.T_a_b
        covariance, adjoint = np.linalg.inv(edge.information), se3.adjoint(T_tail)
        before = np.linalg.inv(share * adjoint @ covariance @ adjoint.T)
        behind = edge.information / (1 - share)
        self.condensed[head, keyframe] = RelativePose(head, keyframe, T_head, before)
        self.condensed[keyframe, tail] = RelativePose(keyframe, tail, T_tail, behind)
        self.interpolated = self.interpolated.without_split(row)
        self.rows = self.interpolated.index()

    def interpolation_error_sigmas(self, keyframe: int, variables: Variables) -> float:
        """Return the difference between two estimates of the pose of a condensed keyframe.

        One estimate uses the variable before the keyframe, the other the variable after it.

        Returns:
            The largest absolute component of the difference, in standard deviations of a loop
            closure (`sigma_loop_rad`, `sigma_loop_m`), times min(f, 1 - f). Here f is the position
            of the keyframe between both variables, 0..1 (`CondensedKeyframes.fractions`). The
            result is 0 if the keyframe is a variable.
        """
        row = self.rows.get(keyframe)
        if row is None:
            return 0.0
        inner = self.interpolated.only(row)
        T_head, T_tail = (variables[k] for k in inner.head_and_tail(0))
        by_head, by_tail = T_head @ inner.T_head[0], T_tail @ inner.T_tail[0]
        off, share = np.abs(se3.log(se3.inverse(by_head) @ by_tail)), float(inner.fractions[0])
        sigmas = np.repeat([self._noise.sigma_loop_rad, self._noise.sigma_loop_m], 3)
        return min(share, 1 - share) * float((off / sigmas).max())

    def relative(self, without: Pair | None = None) -> Iterable[RelativePose]:
        """Yield the measurements except loop closures and the bridge edge of the pair `without`.

        A bridge edge is the measurement that merged two components of the graph.
        """
        yield from self.odometry.values()
        yield from self.condensed.values()
        bridges = (m for pair, m in self.bridges.items() if pair != without)
        yield from map(self.between_variables, bridges)

    # --- condensed keyframes ----------------------------------------------------------------------
    def relative_to_start(self, keyframe: int) -> tuple[int, np.ndarray]:
        """Return the head of a keyframe, and T_head_keyframe [4, 4].

        The head is the last variable before the keyframe. A variable is its own head.
        """
        row = self.rows.get(keyframe)
        if row is None:
            return keyframe, np.eye(4)
        return int(self.interpolated.start_variables[row]), self.interpolated.T_head[row]

    def relative_to_variable(self, keyframe: int) -> tuple[int, np.ndarray]:
        """Return the variable nearest to a keyframe, and T_variable_keyframe [4, 4].

        The variable is the last one before the keyframe or the first one after it. A keyframe that
        is a variable itself is returned with the identity.
        """
        row = self.rows.get(keyframe)
        if row is None or self.interpolated.fractions[row] <= 0.5:
            return self.relative_to_start(keyframe)
        return int(self.interpolated.end_variables[row]), self.interpolated.T_tail[row]

    def ends(self, m: RelativePose) -> tuple[tuple[int, np.ndarray], tuple[int, np.ndarray]]:
        """Return the two variables that replace the keyframes a and b of a measurement.

        A keyframe that is a variable is kept. A condensed keyframe is replaced by its head (the
        last variable before it) or its tail (the first variable after it), whichever is nearer. If
        a and b get the same variable, both are replaced by their heads instead.

        Returns:
            For a, then for b: the id of the variable, and T_variable_keyframe [4, 4].
        """
        a, b = self.relative_to_variable(m.a), self.relative_to_variable(m.b)
        return (
            (a, b) if a[0] != b[0] else (self.relative_to_start(m.a), self.relative_to_start(m.b))
        )

    def between_variables(self, m: RelativePose) -> RelativePose:
        """Return a measurement between two keyframes as one between variables of the graph.

        A condensed keyframe is no variable; `ends` chooses the variable that replaces it. If both
        keyframes are variables, the measurement is returned unchanged.
        """
        (a, T_a), (b, T_b) = self.ends(m)
        if (a, b) == (m.a, m.b):
            return m
        return transfer_measurement(m, se3.inverse(T_a), se3.inverse(T_b), (a, b))

    def _ends_covariance(self, m: RelativePose) -> np.ndarray:
        """Return the covariance [6, 6] that `between_variables` adds to a measurement.

        A condensed keyframe adds the covariance of the measurement from its head to its tail, times
        the way from its variable to the keyframe divided by the way from head to tail. The
        covariance is for perturbations at keyframe b. It is zero if a and b are variables.
        """
        total = np.zeros((6, 6))
        T_b_end = se3.inverse(m.T_a_b), np.eye(4)
        for keyframe, (variable, _), T in zip((m.a, m.b), self.ends(m), T_b_end, strict=True):
            if (row := self.rows.get(keyframe)) is None:
                continue
            pair = self.interpolated.head_and_tail(row)
            share = self.interpolated.fractions[row]
            away = share if variable == pair[0] else 1 - share
            # Adjoint of T_b_tail.
            adjoint = se3.adjoint(T @ se3.inverse(self.interpolated.T_tail[row]))
            covariance = np.linalg.inv(self.condensed[pair].information)
            total += away * adjoint @ covariance @ adjoint.T
        return total

    # --- factors ----------------------------------------------------------------------------------
    def names(self) -> Iterable[Name]:
        """Yield the names of all factors in a fixed order."""
        yield from (("first", k) for k, first in self.first_of.items() if k == first)
        kinds = {"odometry": self.odometry, "condensed": self.condensed, "join": self.bridges}
        for kind, measurements in kinds.items():
            yield from ((kind, *pair) for pair in measurements)
        yield from (("closure", *pair) for pair in self.closures.accepted)
        yield from (("sight", *pair) for pair in self.observations)

    def factor(self, name: Name, initial: Variables) -> gtsam.NonlinearFactor:
        """Build the factor with a given name.

        Args:
            name: Name of the factor, as `names` yields it.
            initial: Values with which the variables were added to the incremental solver.
        """
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
                return self._odometry_factor(self.between_variables(self.bridges[pair]))
            case "closure":
                return self._closure_factor(self.closures.accepted[pair], self._noise.robust_sigmas)
        observation = self.observations[pair]
        return box_factor(
            observation, *self.relative_to_variable(observation.keyframe), self._noise
        )

    def with_closures(
        self, closures: Iterable[RelativePose], initial: Variables
    ) -> list[gtsam.NonlinearFactor]:
        """Return all factors, with the given closures instead of the accepted ones.

        The closures get no robust kernel, so that costs of different solutions can be compared.

        Args:
            closures: Loop closures to use.
            initial: Values with which the variables were added to the incremental solver; the
                first keyframe of each component is fixed at its value.
        """
        others = [self.factor(name, initial) for name in self.names() if name[0] != "closure"]
        return [*others, *(self._closure_factor(closure, 0.0) for closure in closures)]

    def closure_sigmas(self, variables: Variables, closure: RelativePose) -> float:
        """Return the largest component of the whitened residual of a closure, in sigmas."""
        m = self._closure(closure)
        residual = closure_residual(variables[m.a], variables[m.b], m)
        return float(np.abs(np.linalg.cholesky(m.information).T @ residual).max())

    def _odometry_factor(self, m: RelativePose) -> gtsam.NonlinearFactor:
        return between_factor(m.a, m.b, m.T_a_b, odometry_information(m, self._noise))

    def _closure_factor(self, closure: RelativePose, robust_sigmas: float) -> gtsam.NonlinearFactor:
        m = self._closure(closure)
        return between_factor(m.a, m.b, m.T_a_b, m.information, robust_sigmas)

    def _closure(self, m: RelativePose) -> RelativePose:
        """Return a closure as a measurement between variables, with the noise that this adds."""
        own = closure_information(m, self._noise, self._ends_covariance(m))
        return self.between_variables(RelativePose(m.a, m.b, m.T_a_b, own))

    # --- components -------------------------------------------------------------------------------
    def move_component(
        self, younger: int, older: int, T_new_old: np.ndarray, variables: Variables
    ) -> Variables:
        """Move the keyframes and landmarks of a component, and merge it into an older one.

        Args:
            younger: First keyframe of the younger component.
            older: First keyframe of the older component.
            T_new_old: Motion of the younger component in the map, [4, 4].
            variables: Values of all variables before the motion.

        Returns:
            The values of all variables after the motion.
        """
        theirs = {k for k, first in self.first_of.items() if first == younger}
        self.first_of.update(dict.fromkeys(theirs, older))
        return self.moved(theirs, T_new_old, variables)

    def moved(self, theirs: Set[int], T_new_old: np.ndarray, variables: Variables) -> Variables:
        """Return the variables after a motion of some keyframes and the landmarks they observe.

        Args:
            theirs: Ids of the keyframes that move.
            T_new_old: Motion in the map, [4, 4].
            variables: Values of all variables before the motion.
        """
        points = {point_key(s.landmark) for s in self.observations.values() if s.keyframe in theirs}
        moved = {k: T_new_old @ variables[k] for k in variables.keys() & theirs}
        moved |= {k: se3.transform(T_new_old, variables[k]) for k in variables.keys() & points}
        return {k: moved.get(k, value) for k, value in variables.items()}

    def keep_rejected(self, closure: RelativePose) -> None:
        """Store a rejected loop closure, and keep only the newest `max_contradicting` ones."""
        contradicting = {**self.contradicting, pair_of(closure): closure}
        self.contradicting = dict(
            list(contradicting.items())[-self.closures.config.max_contradicting :]
        )

    # --- state ------------------------------------------------------------------------------------
    def pack(self) -> dict[str, Any]:
        """Return the state as arrays and plain values."""
        return {
            "keyframes": np.array(list(self.first_of), np.int64),
            "first_of": np.array(list(self.first_of.values()), np.int64),
            "active": np.array(self.active, np.int64),
            "odometry": pack_relative(self.odometry.values()),
            "condensed": pack_relative(self.condensed.values()),
            "joins": pack_relative(self.bridges.values()),
            "doubts": pack_relative(self.contradicting.values()),
            "closures": self.closures.pack(),
            "sights": pack_observations(self.observations.values()),
            "followers": self.interpolated.pack(),
        }

    def unpack(self, packed: Mapping[str, Any]) -> None:
        """Restore the state that `pack` returned."""
        keyframes = packed["keyframes"].tolist()
        self.first_of = dict(zip(keyframes, packed["first_of"].tolist(), strict=True))
        self.active = packed["active"].tolist()
        self.odometry, self.condensed, self.bridges, self.contradicting = (
            {(m.a, m.b): m for m in unpack_relative(packed[name])}
            for name in ("odometry", "condensed", "joins", "doubts")
        )
        self.closures = LoopClosureSet.unpack(self.closures.config, packed["closures"])
        self.observations = {
            (s.keyframe, s.landmark): s for s in unpack_observations(packed["sights"])
        }
        self.interpolated = CondensedKeyframes(**packed["followers"])
        self.rows = self.interpolated.index()
