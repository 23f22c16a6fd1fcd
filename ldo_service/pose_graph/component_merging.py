"""Bridge edges: the measurements that connect merged components.

The first measurement between two components is accepted, since there is nothing to check it
against. Later closures are checked against it and rejected if they contradict it. A rejected one is
kept. It replaces the bridge edge once more closures agree with it than with the bridge edge.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Set
from copy import copy
from dataclasses import dataclass

import numpy as np

from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import RelativePose

from .factor_store import FactorStore
from .loop_closures import ClosureDecision, Pair, pair_of
from .solver import Variables, solve_batch

Pose = Callable[[int], np.ndarray]  # T_map_keyframe [4, 4]


@dataclass(frozen=True, slots=True)
class BridgeEdge:
    """Bridge edge between two merged components.

    Attributes:
        pair: Keyframes of the edge.
        connected_keyframes: Keyframes that only this edge connects to the first keyframe of their
            component.
    """

    pair: Pair
    connected_keyframes: Set[int]

    def is_across(self, pair: Pair) -> bool:
        """Return whether the bridge edge separates the two keyframes."""
        return (pair[0] in self.connected_keyframes) != (pair[1] in self.connected_keyframes)


def check_against_bridge(
    known: FactorStore, closure: RelativePose, start: Variables, initial: Variables
) -> tuple[ClosureDecision, Variables]:
    """Return the decision on a closure and the variables of the resulting solution.

    Args:
        known: Measurements to check the closure against.
        closure: Closure between keyframes of one component.
        start: Variables that the batch solver starts from.
        initial: Values that the variables were inserted with.
    """
    return known.closures.check(
        closure,
        lambda closures: solve_batch(known.with_closures(closures, initial), start),
        known.closure_sigmas,
    )


def T_new_old(measured: RelativePose, pose: Pose, *, moves_b: bool) -> np.ndarray:
    """Return the motion [4, 4] that brings two keyframes to their measured relative pose.

    It is T_map_a T_a_b T_map_b^-1, which moves b; if not `moves_b`, it is the inverse, which moves
    a.
    """
    T = pose(measured.a) @ measured.T_a_b @ se3.inverse(pose(measured.b))
    return se3.orthonormalize(T if moves_b else se3.inverse(T))


def conflicting_bridges(known: FactorStore, closure: RelativePose) -> list[BridgeEdge]:
    """Return the bridge edges that alone determine the relative pose of a closure's keyframes.

    There are several if the components are merged in a row; one of them may be wrong.
    """
    joins = (BridgeEdge(pair, _hanging_on(known, pair)) for pair in known.joins)
    return [joined for joined in joins if joined.is_across(pair_of(closure))]


def _hanging_on(known: FactorStore, join: Pair) -> Set[int]:
    """Return the keyframes that only this bridge edge connects to the first of their component."""
    first, links = known.first_of[join[0]], defaultdict[int, list[int]](list)
    for m in known.relative(without=join):
        links[m.a].append(m.b)
        links[m.b].append(m.a)
    held, front = set[int](), {known.relative_to_start(first)[0]}
    while front:
        held |= front
        front = {b for a in front for b in links[a]} - held
    ours = (k for k, theirs in known.first_of.items() if theirs == first)
    return {k for k in ours if known.relative_to_start(k)[0] not in held}


def best_bridge_removal(
    known: FactorStore,
    joins: Iterable[BridgeEdge],
    closure: RelativePose,
    pose: Pose,
    variables: Variables,
    initial: Variables,
) -> tuple[BridgeEdge, FactorStore, Variables] | None:
    """Return the bridge edge to remove, with the factors and variables after its replacement.

    Of several candidates it is the one that leaves the most accepted closures. Return None if there
    is no candidate or two are equally good.
    """
    found = [
        (joined, *other)
        for joined in joins
        if (other := replace_bridge_by_consensus(known, joined, closure, pose, variables, initial))
        is not None
    ]
    most = max((len(other.closures.accepted) for _, other, _ in found), default=0)
    best = [one for one in found if len(one[1].closures.accepted) == most]
    return best[0] if len(best) == 1 else None


def replace_bridge_by_consensus(
    known: FactorStore,
    joined: BridgeEdge,
    closure: RelativePose,
    pose: Pose,
    variables: Variables,
    initial: Variables,
) -> tuple[FactorStore, Variables] | None:
    """Return the factors and variables with a bridge edge replaced by a closure.

    Args:
        known: All measurements; they stay unchanged.
        joined: Bridge edge to replace.
        closure: Rejected closure that would replace it.
        pose: Current poses T_map_keyframe [4, 4].
        variables: Current values of the variables.
        initial: Values that the variables were inserted with.

    Returns:
        The new factors and variables, or None unless more closures agree with the new bridge edge
        than with the old one.
    """
    across = [c for pair, c in known.closures.accepted.items() if joined.is_across(pair)]
    doubts = [c for pair, c in known.doubts.items() if joined.is_across(pair)]
    if len(doubts) <= 1 + len(across):
        return None
    other = _exchanged(known, joined, closure)
    moves = T_new_old(closure, pose, moves_b=closure.b in joined.connected_keyframes)
    variables = known.moved(joined.connected_keyframes, moves, variables)
    for one in (*(doubt for doubt in doubts if doubt is not closure), *across):
        verdict, found = check_against_bridge(other, one, variables, initial)
        other.closures = other.closures.with_decision(one, verdict)
        variables = found if verdict.changes else variables
    agreeing = [pair for pair in other.closures.accepted if joined.is_across(pair)]
    if len(agreeing) <= len(across):
        return None
    other.doubts = {pair: c for pair, c in other.doubts.items() if pair not in agreeing}
    return other, variables


def _exchanged(known: FactorStore, joined: BridgeEdge, closure: RelativePose) -> FactorStore:
    """Return the factors with a closure in place of a bridge edge.

    Closures between the two sides are neither accepted nor rejected in them.
    """
    other, pair = copy(known), pair_of(closure)
    across = [p for p in known.closures.accepted if joined.is_across(p)]
    other.joins = {p: m for p, m in known.joins.items() if p != joined.pair} | {pair: closure}
    other.closures = known.closures.without(across).with_replaced_bridge(joined.pair, pair)
    other.doubts = {p: m for p, m in known.doubts.items() if p != pair}
    return other
