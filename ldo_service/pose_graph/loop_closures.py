"""Which loop closures are believed: false ones are worse than missed ones."""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry.keyframe_poses import RelativePose

from .factors import pack_relative, unpack_relative
from .solver import Variables

Pair = tuple[int, int]
Solve = Callable[[Collection[RelativePose]], tuple[Variables, float]]
Sigmas = Callable[[Variables, RelativePose], float]


@dataclass(frozen=True, slots=True)
class LoopClosureConfig:
    # What a closure may add to the sum of squares: chi^2 of six numbers at 3 sigma (99.73 %). Its
    # own residual would not do: a chain of a hundred links bends by a metre and leaves it 2 sigma.
    most_cost: float = 20.06
    most_sigmas: float = 3.0  # of a residual that stays, in any direction (RTAB-Map's guard)
    rivals: int = 3  # earlier closures that may leave in place of a new one, the least fitting
    # believed at a time, 1 kB each and one more to solve with; beyond, the one goes that another is
    # nearest to
    most: int = 500
    doubts: int = 16  # refused ones kept that contradict a join: two that agree outvote it
    remembered: int = 256  # refused ones, and ones that left, to tell

    def __post_init__(self) -> None:
        if min(self.most_cost, self.most_sigmas) <= 0 or self.rivals < 0:
            raise ConfigError(
                named(self, "most_cost", "most_sigmas", "rivals")
                + ": gates must be positive, counts not negative."
            )
        if min(self.most, self.doubts, self.remembered) < 1:
            raise ConfigError(
                named(self, "most", "doubts", "remembered")
                + ": most, doubts and remembered must be at least 1."
            )


@dataclass(frozen=True, slots=True)
class ClosureDecision:
    is_accepted: bool
    dropped: tuple[Pair, ...] = ()  # accepted earlier, and refuted by now

    @property
    def changes(self) -> bool:
        return self.is_accepted or bool(self.dropped)


@dataclass(frozen=True, slots=True)
class LoopClosureSet:
    """Those in the graph, and those that were refused or left it."""

    config: LoopClosureConfig = field(default_factory=LoopClosureConfig)
    accepted: Mapping[Pair, RelativePose] = field(default_factory=dict)
    rejected: tuple[Pair, ...] = ()
    removed: tuple[Pair, ...] = ()

    def check(
        self, closure: RelativePose, solve: Solve, sigmas: Sigmas
    ) -> tuple[ClosureDecision, Variables]:
        """Is it to be believed, and where is everything then.

        `solve` gives the solution with some closures and its sum of squares; `sigmas` the largest
        residual of one in a solution. A new closure that costs too much is refused, unless the
        solution costs less without an earlier one: then that one was false. In the end whichever
        is still off by too much leaves.
        """
        before = [c for pair, c in self.accepted.items() if pair != pair_of(closure)]
        _, cost_before = solve(before)
        chosen = [*before, closure]
        variables, cost = solve(chosen)
        if cost - cost_before > self.config.most_cost:
            rival = self._find_conflicting(closure, before, cost_before, solve, variables, sigmas)
            if rival is None:
                return ClosureDecision(False), variables
            chosen = [c for c in chosen if c is not rival]
            variables, cost = solve(chosen)
        while chosen and (worst := max(chosen, key=lambda c: sigmas(variables, c))):
            if sigmas(variables, worst) <= self.config.most_sigmas:
                break
            chosen = [c for c in chosen if c is not worst]
            variables, cost = solve(chosen)
        kept = {pair_of(c) for c in chosen}
        if pair_of(closure) not in kept and pair_of(closure) in self.accepted:
            return ClosureDecision(False), variables  # what it would have replaced stays
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
        """The earlier closure without which the new one fits, and everything fits better."""
        fitting = sorted(before, key=lambda c: sigmas(variables, c), reverse=True)
        best, best_cost = None, cost_before
        for rival in fitting[: self.config.rivals]:
            others = [c for c in before if c is not rival]
            _, cost_others = solve(others)
            _, cost = solve([*others, closure])
            if cost < best_cost and cost - cost_others <= self.config.most_cost:
                best, best_cost = rival, cost
        return best

    def with_decision(self, closure: RelativePose, verdict: ClosureDecision) -> "LoopClosureSet":
        """A pair is in one of the three, where it was put last."""
        pair = pair_of(closure)
        accepted = {p: c for p, c in self.accepted.items() if p not in verdict.dropped}
        if verdict.is_accepted:
            accepted |= {pair: closure}
        now_refused = {pair} - accepted.keys()
        refused = (p for p in (*self.rejected, *now_refused) if p not in accepted)
        left = (p for p in (*self.removed, *verdict.dropped) if p not in accepted)
        return replace(
            self,
            accepted=self._thinned(accepted),
            rejected=self._remembered(p for p in refused if p not in verdict.dropped),
            removed=self._remembered(p for p in left if p not in now_refused),
        )

    def _thinned(self, accepted: Mapping[Pair, RelativePose]) -> Mapping[Pair, RelativePose]:
        """Without one too many: the older of the two that join the most alike keyframes."""
        if len(accepted) <= self.config.most:
            return accepted
        pairs = np.array(list(accepted))
        apart = np.abs(pairs[:, None] - pairs[None]).sum(axis=2)
        np.fill_diagonal(apart, np.iinfo(apart.dtype).max)
        older = int(np.argmin(apart)) // len(pairs)
        return {p: c for place, (p, c) in enumerate(accepted.items()) if place != older}

    def without(self, pairs: Collection[Pair]) -> "LoopClosureSet":
        """When other measurements hold what these say."""
        return replace(self, accepted={p: c for p, c in self.accepted.items() if p not in pairs})

    def with_replaced_bridge(self, join: Pair, closure: Pair) -> "LoopClosureSet":
        """When a closure joins two components in place of another, which leaves."""
        refused = tuple(pair for pair in self.rejected if pair != closure)
        left = self._remembered((*(pair for pair in self.removed if pair != closure), join))
        return replace(self, rejected=refused, removed=left)

    def _remembered(self, pairs: Iterable[Pair]) -> tuple[Pair, ...]:
        """The newest of them."""
        return tuple(dict.fromkeys(pairs))[-self.config.remembered :]

    def pack(self) -> dict[str, Any]:
        return {
            "accepted": pack_relative(self.accepted.values()),
            "refused": self.rejected,
            "left": self.removed,
        }

    @staticmethod
    def unpack(config: LoopClosureConfig, packed: Mapping[str, Any]) -> "LoopClosureSet":
        accepted = {pair_of(c): c for c in unpack_relative(packed["accepted"])}
        refused, left = (tuple((a, b) for a, b in packed[name]) for name in ("refused", "left"))
        return LoopClosureSet(config, accepted, refused, left)


def pair_of(measured: RelativePose) -> Pair:
    return measured.a, measured.b
