"""Ten keyframes become one variable and a relative measurement to the next: `ldo_service.graph`.

After Grisetti, Kuemmerle and Ni, Robust Optimization of Factor Graphs by using Condensed
Measurements (2012).
"""

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import RelativePose

from .factors import (
    NoiseConfig,
    closure_information,
    first_factor,
    odometry_information,
    relative_factor,
)
from .followers import Followers, between
from .solver import graph_of, values_of, variables_of


@dataclass(frozen=True, slots=True)
class Condensed:
    """The first of a group in the first of the next, and where the others follow."""

    edge: RelativePose
    followers: Followers


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


def condensed(
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
        relative_factor(m.a, m.b, m.T_a_b, odometry_information(m, noise))
        for pair, m in measured.items()
        if inside.issuperset(pair)
    ]
    factors += [
        relative_factor(c.a, c.b, c.T_a_b, closure_information(c, noise, np.zeros((6, 6))))
        for c in closures
    ]
    factors.append(first_factor(head, T_map[head], noise.first_sigma))
    graph, start = graph_of(factors), values_of({k: T_map[k] for k in group})
    values = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    covariance = gtsam.Marginals(graph, values).marginalCovariance(tail)
    solved = variables_of(values)
    T_head_map = se3.inverse(solved[head])
    edge = RelativePose(head, tail, T_head_map @ solved[tail], np.linalg.inv(covariance))
    T_head = np.array([T_head_map @ solved[k] for k in others])
    return Condensed(edge, between(head, tail, others, T_head, edge.T_a_b))


def bridges(gone: Iterable[RelativePose], stays: Iterable[tuple[int, int]]) -> list[RelativePose]:
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


def carried(
    measured: RelativePose, T_a_new: np.ndarray, T_b_new: np.ndarray, new: tuple[int, int]
) -> RelativePose:
    """The same measurement between the keyframes `new`, which hang rigidly on its own: T_a_new and
    T_b_new are where they are in these. What is perturbed at b is perturbed there."""
    T = se3.inverse(T_a_new) @ measured.T_a_b @ T_b_new
    adjoint = se3.adjoint(T_b_new)
    return RelativePose(*new, T, adjoint.T @ measured.information @ adjoint)
