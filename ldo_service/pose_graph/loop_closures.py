"""Acceptance of loop closures.

A false loop closure damages the map more than a missed one, so the criteria are strict.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry.keyframe_poses import RelativePose

from .factors import pack_relative, unpack_relative
from .solver import Variables

Pair = tuple[int, int]
# Function that solves the graph with some closures; it returns the variables and the sum of squared
# residuals.
Solve = Callable[[Collection[RelativePose]], tuple[Variables, float]]
# Function that returns the largest whitened residual of a closure in a solution, in sigmas.
Sigmas = Callable[[Variables, RelativePose], float]


@dataclass(frozen=True, slots=True)
class LoopClosureConfig:
    """Limits for the acceptance of loop closures.

    Limits in sigmas are multiples of the standard deviation of the measurement.
    """

    # Maximum increase of the sum of squared residuals by a closure: the 99.73 % quantile (3
    # sigma) of chi^2 with six degrees of freedom. The residual of the closure alone does not show
    # a false closure. A false closure can move a chain of 100 measurements by a meter, so that its
    # own residual is only 2 sigma.
    max_cost: float = 20.06
    # Maximum residual of an accepted closure in any direction, in sigmas (as in RTAB-Map).
    max_sigmas: float = 3.0
    # If a new closure does not fit, the earlier closures with the largest residuals are tested for
    # removal. This is the maximum number of tests.
    max_removal_tests: int = 3
    # Maximum number of accepted closures; each needs 1 kB and one more factor in the solver.
    # If there are more, the older of the two most similar closures is removed.
    max_closures: int = 500
    # Maximum number of stored closures that contradict a bridge edge. One of these closures
    # replaces the edge if more closures agree with it than with the edge (`component_merging`).
    max_contradicting: int = 16
    # Maximum number of rejected closures, and of removed closures, that are stored for publication.
    max_rejected: int = 256

    def __post_init__(self) -> None:
        if min(self.max_cost, self.max_sigmas) <= 0 or self.max_removal_tests < 0:
            raise ConfigError(
                named(self, "max_cost", "max_sigmas", "max_removal_tests")
                + ": max_cost and max_sigmas must be positive, max_removal_tests at least 0."
            )
        if min(self.max_closures, self.max_contradicting, self.max_rejected) < 1:
            raise ConfigError(
                named(self, "max_closures", "max_contradicting", "max_rejected")
                + ": max_closures, max_contradicting and max_rejected must be at least 1."
            )


@dataclass(frozen=True, slots=True)
class ClosureDecision:
    """Decision to accept or to reject a loop closure."""

    is_accepted: bool
    dropped: tuple[Pair, ...] = ()  # Earlier accepted closures that are now removed.

    @property
    def changes(self) -> bool:
        """True if the set of accepted closures changes."""
        return self.is_accepted or bool(self.dropped)


@dataclass(frozen=True, slots=True)
class LoopClosureSet:
    """Immutable set of the accepted, rejected and removed loop closures."""

    config: LoopClosureConfig = field(default_factory=LoopClosureConfig)
    accepted: Mapping[Pair, RelativePose] = field(default_factory=dict)
    rejected: tuple[Pair, ...] = ()
    removed: tuple[Pair, ...] = ()

    def check(
        self, closure: RelativePose, solve: Solve, sigmas: Sigmas
    ) -> tuple[ClosureDecision, Variables]:
        """Check a new closure against the accepted ones.

        The new closure is rejected if it increases the cost of the solution by more than
        `max_cost`. There is one exception: if replacing an earlier closure by the new one lowers
        the cost, the earlier closure is regarded as false and removed. At the end, all closures
        with a residual above `max_sigmas` are removed, the worst first.

        Args:
            closure: New closure.
            solve: Function that returns the solution with some closures, and its sum of squared
                residuals.
            sigmas: Function that returns the largest whitened residual of a closure in a solution.

        Returns:
            The decision, and the variables of the last solution.
        """
        before = [c for pair, c in self.accepted.items() if pair != pair_of(closure)]
        _, cost_before = solve(before)
        chosen = [*before, closure]
        variables, cost = solve(chosen)
        if cost - cost_before > self.config.max_cost:
            conflicting = self._find_conflicting(
                closure, before, cost_before, solve, variables, sigmas
            )
            if conflicting is None:
                return ClosureDecision(False), variables
            chosen = [c for c in chosen if c is not conflicting]
            variables, cost = solve(chosen)
        while chosen and (worst := max(chosen, key=lambda c: sigmas(variables, c))):
            if sigmas(variables, worst) <= self.config.max_sigmas:
                break
            chosen = [c for c in chosen if c is not worst]
            variables, cost = solve(chosen)
        kept = {pair_of(c) for c in chosen}
        if pair_of(closure) not in kept and pair_of(closure) in self.accepted:
            return ClosureDecision(False), variables  # The earlier closure of the pair stays.
        dropped = tuple(pair for pair in self.accepted if pair not in kept)
        return ClosureDecision(pair_of(closure) in kept, dropped), variables

    def _find_conflicting(
        self,
        closure: RelativePose,
        before: list[RelativePose],
        cost_before: float,
        solve: Solve,
        variables: Variables,
        sigmas: Sigmas,
    ) -> RelativePose | None:
        """Return the earlier closure whose replacement by the new one gives the lowest cost.

        This cost must be below `cost_before`, and the new closure must increase the cost without
        the earlier one by at most `max_cost`. Return None if no tested closure meets both criteria.
        """
        fitting = sorted(before, key=lambda c: sigmas(variables, c), reverse=True)
        best, best_cost = None, cost_before
        for conflicting in fitting[: self.config.max_removal_tests]:
            others = [c for c in before if c is not conflicting]
            _, cost_others = solve(others)
            _, cost = solve([*others, closure])
            if cost < best_cost and cost - cost_others <= self.config.max_cost:
                best, best_cost = conflicting, cost
        return best

    def with_decision(self, closure: RelativePose, decision: ClosureDecision) -> "LoopClosureSet":
        """Return the set after a decision.

        A pair of keyframes is listed only once, by its latest decision: as accepted, rejected or
        removed.
        """
        pair = pair_of(closure)
        accepted = {p: c for p, c in self.accepted.items() if p not in decision.dropped}
        if decision.is_accepted:
            accepted |= {pair: closure}
        now_refused = {pair} - accepted.keys()
        refused = (p for p in (*self.rejected, *now_refused) if p not in accepted)
        left = (p for p in (*self.removed, *decision.dropped) if p not in accepted)
        return replace(
            self,
            accepted=self._thinned(accepted),
            rejected=self._newest(p for p in refused if p not in decision.dropped),
            removed=self._newest(p for p in left if p not in now_refused),
        )

    def _thinned(self, accepted: Mapping[Pair, RelativePose]) -> Mapping[Pair, RelativePose]:
        """Return at most `max_closures` closures.

        If there is one more, the two closures with the most similar keyframe ids are regarded as
        redundant, and the older one of these two is removed.
        """
        if len(accepted) <= self.config.max_closures:
            return accepted
        pairs = np.array(list(accepted))
        apart = np.abs(pairs[:, None] - pairs[None]).sum(axis=2)
        np.fill_diagonal(apart, np.iinfo(apart.dtype).max)
        older = int(np.argmin(apart)) // len(pairs)
        return {p: c for place, (p, c) in enumerate(accepted.items()) if place != older}

    def without(self, pairs: Collection[Pair]) -> "LoopClosureSet":
        """Return the set without the closures between some pairs of keyframes.

        The closures are not listed as removed, since other measurements contain their information.
        """
        return replace(self, accepted={p: c for p, c in self.accepted.items() if p not in pairs})

    def with_replaced_bridge(self, bridge: Pair, closure: Pair) -> "LoopClosureSet":
        """Return the set after a closure replaced a bridge edge; the old edge is listed as removed.

        A bridge edge is a loop closure that merged two components of the graph.

        Args:
            bridge: Keyframes of the old bridge edge.
            closure: Keyframes of the closure that replaced it.
        """
        refused = tuple(pair for pair in self.rejected if pair != closure)
        left = self._newest((*(pair for pair in self.removed if pair != closure), bridge))
        return replace(self, rejected=refused, removed=left)

    def _newest(self, pairs: Iterable[Pair]) -> tuple[Pair, ...]:
        """Return the newest pairs, at most `max_rejected`."""
        return tuple(dict.fromkeys(pairs))[-self.config.max_rejected :]

    def pack(self) -> dict[str, Any]:
        """Return the set as arrays and plain values."""
        return {
            "accepted": pack_relative(self.accepted.values()),
            "refused": self.rejected,
            "left": self.removed,
        }

    @staticmethod
    def unpack(config: LoopClosureConfig, packed: Mapping[str, Any]) -> "LoopClosureSet":
        """Return the set that `pack` packed."""
        accepted = {pair_of(c): c for c in unpack_relative(packed["accepted"])}
        refused, left = (tuple((a, b) for a, b in packed[name]) for name in ("refused", "left"))
        return LoopClosureSet(config, accepted, refused, left)


def pair_of(measured: RelativePose) -> Pair:
    """Return the two keyframes of a measurement."""
    return measured.a, measured.b
