"""Condensation: ten keyframes become one variable and a relative measurement to the next one.

After Grisetti, Kuemmerle and Ni, Robust Optimization of Factor Graphs by using Condensed
Measurements (2012). Keyframes that are no longer variables keep their place between two that are.
"""

from collections.abc import Container, Iterable, Mapping, Sequence
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
    """F keyframes, each between the variables `heads` and `end_variables`, ids [F].

    T_head [F, 4, 4] is T_head_keyframe and T_tail T_tail_keyframe, as measured; `fractions` [F] how
    far along it is: what corrections change between head and tail is spread over them.
    """

    keyframes: np.ndarray  # ascending within a group
    start_variables: np.ndarray
    end_variables: np.ndarray
    T_head: np.ndarray
    T_tail: np.ndarray
    fractions: np.ndarray

    @staticmethod
    def none() -> "CondensedKeyframes":
        ids, transforms = np.zeros(0, np.int64), np.zeros((0, 4, 4))
        return CondensedKeyframes(ids, ids, ids, transforms, transforms, np.zeros(0))

    def joined_by(self, more: "CondensedKeyframes") -> "CondensedKeyframes":
        columns = (getattr(self, name) for name in self.__slots__)
        others = (getattr(more, name) for name in self.__slots__)
        return CondensedKeyframes(*map(np.concatenate, zip(columns, others, strict=True)))

    def only(self, row: int) -> "CondensedKeyframes":
        return CondensedKeyframes(*(getattr(self, name)[row : row + 1] for name in self.__slots__))

    def index(self) -> dict[int, int]:
        """Row of each keyframe."""
        return {int(k): row for row, k in enumerate(self.keyframes)}

    def interpolated_poses(self, T_heads: np.ndarray, T_tails: np.ndarray) -> np.ndarray:
        """T_map_keyframe [F, 4, 4], from where heads and tails [F, 4, 4] are in the map."""
        return interpolate(T_heads @ self.T_head, T_tails @ self.T_tail, self.fractions)

    def moved(self, row: int, T_head_keyframe: np.ndarray) -> "CondensedKeyframes":
        """One measured anew."""
        T_tail_head = self.T_tail[row] @ np.linalg.inv(self.T_head[row])
        T_head, T_tail = self.T_head.copy(), self.T_tail.copy()
        T_head[row], T_tail[row] = T_head_keyframe, T_tail_head @ T_head_keyframe
        return replace(self, T_head=T_head, T_tail=T_tail)

    def without_split(self, row: int) -> "CondensedKeyframes":
        """Without one, which is a variable again: those of its group lie before or behind it."""
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
        return CondensedKeyframes(
            *(np.delete(getattr(self, name), row, 0) for name in self.__slots__)
        )

    def pack(self) -> dict[str, np.ndarray]:
        return {name: getattr(self, name) for name in self.__slots__}


def condense_between(
    head: int,
    tail: int,
    keyframes: Sequence[int],
    T_head: np.ndarray,
    T_head_tail: np.ndarray,
) -> CondensedKeyframes:
    """Those that were made between two, one after another, T_head [n, 4, 4]."""
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
    """The first of a group in the first of the next, and where the others follow."""

    edge: RelativePose
    followers: CondensedKeyframes


def group_to_condense(
    active: Sequence[int],
    measured: Iterable[tuple[int, int]],
    heads: Container[int],
    size: int,
    window: int,
) -> list[int]:
    """The oldest `size` active keyframes that odometry connects one after another, and the next;
    none of the newest `window`. One of `heads`, that others follow, is the first of its group, as
    it cannot follow itself. Empty where there are none.

    The next after a group, where odometry goes on, is measured from its last, or the group is
    longer, up to twice: one that is measured from others of it would hang on an end of the group,
    and take what a correction bends there alone."""
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
    """What a group knows by itself: head, those that will follow, and the tail, the next head.

    The measurements and closures within the group alone are solved, with the head held, so that
    what other loops did to it is not counted twice and can be undone. Covariance is that of the
    tail, marginal.
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
    """The first measurements among `gone` without which variables would be held by nothing, when
    the pairs `stays` are connected."""
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
    """The same measurement between the keyframes `new`, which hang rigidly on its own: T_a_new and
    T_b_new are where they are in these. What is perturbed at b is perturbed there."""
    T = se3.inverse(T_a_new) @ measured.T_a_b @ T_b_new
    adjoint = se3.adjoint(T_b_new)
    return RelativePose(*new, T, adjoint.T @ measured.information @ adjoint)
