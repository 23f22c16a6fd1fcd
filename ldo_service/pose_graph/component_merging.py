"""Which measurement between what were two components holds them together.

The first is believed: there is nothing to judge it by. A later one is judged by it, and refused
where the two contradict each other: one word stands against another. What is refused so is kept as
a doubt, and once more closures agree with a doubt than with the join, it joins in its place.
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
    """A join, and the keyframes that it alone holds to the first of their component."""

    pair: Pair
    connected_keyframes: Set[int]

    def is_across(self, pair: Pair) -> bool:
        return (pair[0] in self.connected_keyframes) != (pair[1] in self.connected_keyframes)


def check_against_bridge(
    known: FactorStore, closure: RelativePose, start: Variables, initial: Variables
) -> tuple[ClosureDecision, Variables]:
    """A closure among some measurements, and where everything is then."""
    return known.closures.check(
        closure,
        lambda closures: solve_batch(known.with_closures(closures, initial), start),
        known.closure_sigmas,
    )


def T_new_old(measured: RelativePose, pose: Pose, *, moves_b: bool) -> np.ndarray:
    """[4, 4] T_map_a T_a_b T_map_b^-1, which brings b to where it was measured, or the inverse,
    which brings a there."""
    T = pose(measured.a) @ measured.T_a_b @ se3.inverse(pose(measured.b))
    return se3.orthonormalize(T if moves_b else se3.inverse(T))


def conflicting_bridges(known: FactorStore, closure: RelativePose) -> list[BridgeEdge]:
    """The joins each of which alone says where the ends of a closure are to each other: several in
    a row, of which one may be wrong."""
    joins = (BridgeEdge(pair, _hanging_on(known, pair)) for pair in known.joins)
    return [joined for joined in joins if joined.is_across(pair_of(closure))]


def _hanging_on(known: FactorStore, join: Pair) -> Set[int]:
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
    """The join that is outvoted, and what is known without it. Of several the one without which
    most closures are believed; None where two are as good."""
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
    """Joined by a closure instead, if more closures agree with that; None: the join stays.

    pose, variables   where everything is
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
    """With a closure in place of the join; those between its sides are neither believed nor
    refused there."""
    other, pair = copy(known), pair_of(closure)
    across = [p for p in known.closures.accepted if joined.is_across(p)]
    other.joins = {p: m for p, m in known.joins.items() if p != joined.pair} | {pair: closure}
    other.closures = known.closures.without(across).with_replaced_bridge(joined.pair, pair)
    other.doubts = {p: m for p, m in known.doubts.items() if p != pair}
    return other
