"""Condensation: ten keyframes become one variable and a relative measurement to the next variable.

The method follows Grisetti, Kuemmerle and Ni, Robust Optimization of Factor Graphs by using
Condensed Measurements (2012). The poses of condensed keyframes are interpolated between two
variables.
"""

from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import RelativePose
from ldo_service.geometry.se3 import interpolate

from .factors import (
    NoiseConfig,
    between_factor,
    closure_information,
    odometry_information,
    prior_factor,
)
from .solver import graph_of, values_of, variables_of


@dataclass(frozen=True, slots=True)
class CondensedKeyframes:
    """Condensed keyframes as arrays with one row for each of the F keyframes.

    A condensed keyframe is not a variable of the pose graph. Its pose is interpolated between two
    variables: its head, the last variable before it, and its tail, the first variable after it.
    Keyframes with the same head and tail form a group.

    Attributes:
        keyframes: Ids, [F], ascending within a group.
        start_variables: Ids of the heads, [F].
        end_variables: Ids of the tails, [F].
        T_head: Measured T_head_keyframe, [F, 4, 4].
        T_tail: Measured T_tail_keyframe, [F, 4, 4].
        fractions: Position of each keyframe between its head (0) and its tail (1), [F]. If the
            pose of the tail relative to the head changes, the keyframe moves by this fraction
            of the change.
    """

    keyframes: np.ndarray
    start_variables: np.ndarray
    end_variables: np.ndarray
    T_head: np.ndarray
    T_tail: np.ndarray
    fractions: np.ndarray

    @staticmethod
    def none() -> "CondensedKeyframes":
        """Return an empty instance."""
        ids, transforms = np.zeros(0, np.int64), np.zeros((0, 4, 4))
        return CondensedKeyframes(ids, ids, ids, transforms, transforms, np.zeros(0))

    def merged_with(self, more: "CondensedKeyframes") -> "CondensedKeyframes":
        """Return these condensed keyframes with those of `more` appended."""
        columns = (getattr(self, name) for name in self.__slots__)
        others = (getattr(more, name) for name in self.__slots__)
        return CondensedKeyframes(*map(np.concatenate, zip(columns, others, strict=True)))

    def only(self, row: int) -> "CondensedKeyframes":
        """Return the condensed keyframe of one row, as arrays of length 1."""
        return CondensedKeyframes(*(getattr(self, name)[row : row + 1] for name in self.__slots__))

    def head_and_tail(self, row: int) -> tuple[int, int]:
        """Return the ids of the head and the tail of the condensed keyframe of one row.

        The head is the last variable before the keyframe, and the tail the first variable after it.
        """
        return int(self.start_variables[row]), int(self.end_variables[row])

    def index(self) -> dict[int, int]:
        """Return the row of each condensed keyframe, by id."""
        return {int(k): row for row, k in enumerate(self.keyframes)}

    def interpolated_poses(self, T_heads: np.ndarray, T_tails: np.ndarray) -> np.ndarray:
        """Return T_map_keyframe [F, 4, 4], interpolated between head and tail of each keyframe.

        Args:
            T_heads: Pose T_map_head of the last variable before each keyframe, [F, 4, 4].
            T_tails: Pose T_map_tail of the first variable after each keyframe, [F, 4, 4].
        """
        return interpolate(T_heads @ self.T_head, T_tails @ self.T_tail, self.fractions)

    def pose_at(self, row: int, pose: Callable[[int], np.ndarray]) -> np.ndarray:
        """Return T_map_keyframe [4, 4] of the condensed keyframe of one row.

        Args:
            row: Row of the keyframe.
            pose: Function that returns T_map_keyframe [4, 4] of a variable by its id. The
                arguments are the ids of the head (variable before the keyframe) and the tail
                (variable after it).
        """
        one = self.only(row)
        T_head, T_tail = (pose(k)[None] for k in one.head_and_tail(0))
        return one.interpolated_poses(T_head, T_tail)[0]

    def poses_with_variables(
        self, variables: np.ndarray, T_map_variable: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the ids [K], ascending, and T_map_keyframe [K, 4, 4] of all keyframes.

        Args:
            variables: Ids of the V keyframes that are variables, [V], ascending.
            T_map_variable: Poses of these variables in the map, [V, 4, 4].
        """
        heads, tails = (
            np.searchsorted(variables, ids) for ids in (self.start_variables, self.end_variables)
        )
        keyframes = np.concatenate([variables, self.keyframes])
        order = np.argsort(keyframes)
        T_map = self.interpolated_poses(T_map_variable[heads], T_map_variable[tails])
        return keyframes[order], np.concatenate([T_map_variable, T_map])[order]

    def moved(self, row: int, T_head_keyframe: np.ndarray) -> "CondensedKeyframes":
        """Return a copy in which one keyframe has a new pose relative to its head and its tail.

        The head is the variable before the keyframe, and the tail the variable after it. The pose
        relative to the tail is computed from the pose relative to the head.

        Args:
            row: Row of the moved keyframe.
            T_head_keyframe: New pose of the keyframe relative to its head, [4, 4].
        """
        T_tail_head = self.T_tail[row] @ np.linalg.inv(self.T_head[row])
        T_head, T_tail = self.T_head.copy(), self.T_tail.copy()
        T_head[row], T_tail[row] = T_head_keyframe, T_tail_head @ T_head_keyframe
        return replace(self, T_head=T_head, T_tail=T_tail)

    def without_split(self, row: int) -> "CondensedKeyframes":
        """Return a copy without one condensed keyframe, which becomes a variable again.

        The new variable divides its group in two: it is the last variable (tail) of the first part
        and the first variable (head) of the second part.

        Args:
            row: Row of the keyframe that becomes a variable.
        """
        of_group = (self.start_variables == self.start_variables[row]) & (
            self.end_variables == self.end_variables[row]
        )
        share = self.fractions[row]
        before, behind = of_group & (self.fractions < share), of_group & (self.fractions > share)
        to_head, to_tail = np.linalg.inv(self.T_head[row]), np.linalg.inv(self.T_tail[row])
        one = self.keyframes[row]
        parted = replace(
            self,
            start_variables=np.where(behind, one, self.start_variables),
            end_variables=np.where(before, one, self.end_variables),
            T_head=np.where(behind[:, None, None], to_head @ self.T_head, self.T_head),
            T_tail=np.where(before[:, None, None], to_tail @ self.T_tail, self.T_tail),
            fractions=np.select(
                [before, behind],
                [self.fractions / share, (self.fractions - share) / (1 - share)],
                self.fractions,
            ),
        )
        return parted.without(row)

    def without(self, row: int) -> "CondensedKeyframes":
        """Return a copy without the condensed keyframe of one row."""
        return CondensedKeyframes(
            *(np.delete(getattr(self, name), row, 0) for name in self.__slots__)
        )

    def pack(self) -> dict[str, np.ndarray]:
        """Return the arrays of the condensed keyframes by name."""
        return {name: getattr(self, name) for name in self.__slots__}


def condense_between(
    head: int,
    tail: int,
    keyframes: Sequence[int],
    T_head: np.ndarray,
    T_head_tail: np.ndarray,
) -> CondensedKeyframes:
    """Return the keyframes between two variables as condensed keyframes.

    The `fractions` of the keyframes are evenly spaced: k / (n + 1) for the k-th of n keyframes.

    Args:
        head: Id of the first variable.
        tail: Id of the second variable.
        keyframes: Ids of the n keyframes between both variables, in order.
        T_head: Measured T_head_keyframe, [n, 4, 4].
        T_head_tail: Measured pose of the second variable in the first one, [4, 4].
    """
    n = len(keyframes)
    return CondensedKeyframes(
        np.array(keyframes, np.int64),
        np.full(n, head),
        np.full(n, tail),
        np.array(T_head),
        np.linalg.inv(T_head_tail) @ T_head,
        np.arange(1, n + 1) / (n + 1),
    )


@dataclass(frozen=True, slots=True)
class Condensed:
    """Group of keyframes after condensation: one measurement and the keyframes that it spans."""

    edge: RelativePose  # Measurement from the first keyframe of the group to the last one.
    interpolated: CondensedKeyframes  # The keyframes between these two.


def group_to_condense(
    active: Sequence[int],
    measured: Iterable[tuple[int, int]],
    heads: Container[int],
    size: int,
    window: int,
) -> list[int]:
    """Choose the next group to condense: the oldest chain of at least `size` + 1 keyframes.

    In a chain, each keyframe after the first has an odometry measurement from an earlier keyframe
    of the chain. The first keyframe of a group is its head, and the last one is its tail. Head and
    tail stay variables. The head or tail of an existing group may only be the head of a new group.

    The group is extended, up to twice `size`, if the next keyframe has measurements relative to the
    group, but none relative to the tail. Without the extension, condensation would transfer these
    measurements to the head or the tail. Later corrections would then move the next keyframe with
    the head or the tail only.

    Args:
        active: Keyframes that may still be condensed, ascending (`FactorStore.active`).
        measured: Pairs of variables with an odometry measurement.
        heads: Ids of the heads and tails of existing groups.
        size: Number of keyframes in a group, without the tail.
        window: Number of newest keyframes that are never condensed.

    Returns:
        The head, the keyframes to condense and the tail, or an empty list if no chain is long
        enough.
    """
    linked = {frozenset(pair) for pair in measured}

    def are_linked(run: Sequence[int], keyframe: int) -> bool:
        return any(frozenset((k, keyframe)) in linked for k in run)

    run: list[int] = []
    for place, keyframe in enumerate(active[:-window] if window else active):
        if keyframe in heads or not are_linked(run, keyframe):
            run = []
        run.append(keyframe)
        following = active[place + 1 : place + 2]
        passes_by = any(are_linked(run[:-1], k) for k in following)
        is_end = not passes_by or any(are_linked([keyframe], k) for k in following)
        if len(run) > 2 * size or (len(run) > size and is_end):
            return run
    return []


def condense(
    group: Sequence[int],
    measured: Mapping[tuple[int, int], RelativePose],
    closures: Iterable[RelativePose],
    T_map: Mapping[int, np.ndarray],
    noise: NoiseConfig,
) -> Condensed:
    """Condense a group: compute one measurement from its first keyframe (head) to its last (tail).

    The measurement is computed only from the measurements and loop closures within the group, with
    the head fixed. Information from outside the group would otherwise count twice.

    Args:
        group: Ids of the keyframes, in order; the first one is the head, the last one the tail.
        measured: Odometry measurements by the ids of their two keyframes.
        closures: Accepted loop closures within the group.
        T_map: Current pose T_map_keyframe [4, 4] of each keyframe of the group.
        noise: Noise of the measurements.

    Returns:
        The condensed group. The covariance of its measurement is the marginal covariance of the
        tail.
    """
    head, *others, tail = group
    inside = set(group)
    factors = [
        between_factor(m.a, m.b, m.T_a_b, odometry_information(m, noise))
        for pair, m in measured.items()
        if inside.issuperset(pair)
    ]
    factors += [
        between_factor(c.a, c.b, c.T_a_b, closure_information(c, noise, np.zeros((6, 6))))
        for c in closures
    ]
    factors.append(prior_factor(head, T_map[head], noise.first_sigma))
    graph, start = graph_of(factors), values_of({k: T_map[k] for k in group})
    values = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    covariance = gtsam.Marginals(graph, values).marginalCovariance(tail)
    solved = variables_of(values)
    T_head_map = se3.inverse(solved[head])
    edge = RelativePose(head, tail, T_head_map @ solved[tail], np.linalg.inv(covariance))
    T_head = np.array([T_head_map @ solved[k] for k in others])
    return Condensed(edge, condense_between(head, tail, others, T_head, edge.T_a_b))


def connecting_measurements(
    gone: Iterable[RelativePose], stays: Iterable[tuple[int, int]]
) -> list[RelativePose]:
    """Select the measurements that must be kept so that all variables stay connected.

    If several measurements would connect the same parts of the graph, the first one is selected.

    Args:
        gone: Measurements that are about to be removed, from which the function selects.
        stays: Pairs of variables between which another measurement remains.
    """
    root: dict[int, int] = {}

    def find(k: int) -> int:
        while root.setdefault(k, k) != k:
            k = root[k]
        return k

    for a, b in stays:
        root[find(a)] = find(b)
    needed = []
    for m in gone:
        if find(m.a) != find(m.b):
            root[find(m.a)] = find(m.b)
            needed.append(m)
    return needed


def transfer_measurement(
    measured: RelativePose, T_a_new: np.ndarray, T_b_new: np.ndarray, new: tuple[int, int]
) -> RelativePose:
    """Convert a measurement between keyframes a and b to one between two other keyframes.

    The first new keyframe is treated as rigidly attached to a, and the second one to b.

    Args:
        measured: Measured pose of b in a.
        T_a_new: Pose of the first new keyframe in a, [4, 4].
        T_b_new: Pose of the second new keyframe in b, [4, 4].
        new: Ids of the new keyframes.

    Returns:
        The measurement. Its information matrix is for perturbations at the second new keyframe.
    """
    T = se3.inverse(T_a_new) @ measured.T_a_b @ T_b_new
    adjoint = se3.adjoint(T_b_new)
    return RelativePose(*new, T, adjoint.T @ measured.information @ adjoint)
