"""Bridge edges: loop closures that merged two components of the pose graph.

A component is a set of keyframes connected by measurements. The first loop closure between two
components is accepted as the bridge edge, since no other measurement exists to check it against.
Later closures that contradict the bridge edge are rejected but stored. A rejected closure replaces
the bridge edge as soon as more closures agree with the rejected closure than with the bridge edge.
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
        pair: Ids of the two keyframes that the edge connects.
        connected_keyframes: Ids of the keyframes on the far side of the edge. Without the edge,
            these keyframes would not be connected to the first keyframe of the component.
    """

    pair: Pair
    connected_keyframes: Set[int]

    def is_across(self, pair: Pair) -> bool:
        """Return whether the two keyframes of `pair` lie on different sides of this bridge edge."""
        return (pair[0] in self.connected_keyframes) != (pair[1] in self.connected_keyframes)


def check_against_bridge(
    known: FactorStore, closure: RelativePose, start: Variables, initial: Variables
) -> tuple[ClosureDecision, Variables]:
    """Check a loop closure against all other measurements, including the bridge edges.

    A bridge edge is the loop closure that merged two components of the graph.

    Args:
        known: The other measurements.
        closure: Loop closure between keyframes of one component.
        start: Values from which the batch solver starts.
        initial: Values with which the variables were added to the incremental solver.

    Returns:
        The decision, and the variables of the resulting solution.
    """
    return known.closures.check(
        closure,
        lambda closures: solve_batch(known.with_closures(closures, initial), start),
        known.closure_sigmas,
    )


def T_new_old(measured: RelativePose, pose: Pose, *, moves_b: bool) -> np.ndarray:
    """Return the motion [4, 4] that brings two keyframes to their measured relative pose.

    Args:
        measured: Measured relative pose of the keyframes a and b.
        pose: Function that returns T_map_keyframe [4, 4].
        moves_b: True to move b: the result is T_map_a T_a_b T_map_b^-1. False to move a: the
            result is the inverse of that product.
    """
    T = pose(measured.a) @ measured.T_a_b @ se3.inverse(pose(measured.b))
    return se3.orthonormalize(T if moves_b else se3.inverse(T))


def conflicting_bridges(known: FactorStore, closure: RelativePose) -> list[BridgeEdge]:
    """Return the bridge edges that lie between the two keyframes of a closure.

    A bridge edge is a loop closure that merged two components of the graph. If several components
    were merged one after the other, several bridge edges may lie between the keyframes. Any of
    these edges may be wrong.
    """
    bridges = (BridgeEdge(pair, _connected_by(known, pair)) for pair in known.bridges)
    return [bridge for bridge in bridges if bridge.is_across(pair_of(closure))]


def _connected_by(known: FactorStore, bridge: Pair) -> Set[int]:
    """Return the keyframes on the far side of a bridge edge; see `BridgeEdge`."""
    first, links = known.first_of[bridge[0]], defaultdict[int, list[int]](list)
    for m in known.relative(without=bridge):
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
    bridges: Iterable[BridgeEdge],
    closure: RelativePose,
    pose: Pose,
    variables: Variables,
    initial: Variables,
) -> tuple[BridgeEdge, FactorStore, Variables] | None:
    """Replace one of several bridge edges by a closure if more closures are then accepted.

    A bridge edge is a loop closure that merged two components of the graph. The replacement of each
    edge is tried by `replace_bridge_by_consensus`. The replacement with the most accepted closures
    is chosen.

    Args:
        known: Store of all measurements, which is not changed.
        bridges: Bridge edges that may be replaced.
        closure: Rejected closure that would become the bridge edge.
        pose: Function that returns the current T_map_keyframe [4, 4].
        variables: Current values of the variables.
        initial: Values with which the variables were added to the incremental solver.

    Returns:
        The replaced bridge edge, then the store and the variables after the replacement. None if no
        replacement increases the number of accepted closures, or if the best two are equally good.
    """
    found = [
        (bridge, *other)
        for bridge in bridges
        if (other := replace_bridge_by_consensus(known, bridge, closure, pose, variables, initial))
        is not None
    ]
    most = max((len(other.closures.accepted) for _, other, _ in found), default=0)
    best = [one for one in found if len(one[1].closures.accepted) == most]
    return best[0] if len(best) == 1 else None


def replace_bridge_by_consensus(
    known: FactorStore,
    bridge: BridgeEdge,
    closure: RelativePose,
    pose: Pose,
    variables: Variables,
    initial: Variables,
) -> tuple[FactorStore, Variables] | None:
    """Replace a bridge edge by a rejected closure if more closures are then accepted.

    A bridge edge is a loop closure that merged two components of the graph. The accepted closures
    between the two sides of the edge are counted before and after the replacement.

    Args:
        known: Store of all measurements, which is not changed.
        bridge: Bridge edge to replace.
        closure: Rejected closure that would become the bridge edge.
        pose: Function that returns the current T_map_keyframe [4, 4].
        variables: Current values of the variables.
        initial: Values with which the variables were added to the incremental solver.

    Returns:
        The store and the variables after the replacement. None if the number of accepted closures
        does not increase.
    """
    across = [c for pair, c in known.closures.accepted.items() if bridge.is_across(pair)]
    contradicting = [c for pair, c in known.contradicting.items() if bridge.is_across(pair)]
    if len(contradicting) <= 1 + len(across):
        return None
    other = _exchanged(known, bridge, closure)
    moves = T_new_old(closure, pose, moves_b=closure.b in bridge.connected_keyframes)
    variables = known.moved(bridge.connected_keyframes, moves, variables)
    for one in (
        *(other_closure for other_closure in contradicting if other_closure is not closure),
        *across,
    ):
        decision, found = check_against_bridge(other, one, variables, initial)
        other.closures = other.closures.with_decision(one, decision)
        variables = found if decision.changes else variables
    agreeing = [pair for pair in other.closures.accepted if bridge.is_across(pair)]
    if len(agreeing) <= len(across):
        return None
    other.contradicting = {
        pair: c for pair, c in other.contradicting.items() if pair not in agreeing
    }
    return other, variables


def _exchanged(known: FactorStore, bridge: BridgeEdge, closure: RelativePose) -> FactorStore:
    """Return a copy of the store with a closure in place of a bridge edge.

    The accepted closures between the two sides of the edge are removed from the copy. The caller
    checks them again.
    """
    other, pair = copy(known), pair_of(closure)
    across = [p for p in known.closures.accepted if bridge.is_across(p)]
    other.bridges = {p: m for p, m in known.bridges.items() if p != bridge.pair} | {pair: closure}
    other.closures = known.closures.without(across).with_replaced_bridge(bridge.pair, pair)
    other.contradicting = {p: m for p, m in known.contradicting.items() if p != pair}
    return other
