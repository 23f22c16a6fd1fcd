"""Incremental smoothing (iSAM2) of keyframe poses from relative measurements and landmarks."""

from collections.abc import Iterable, Mapping, Sequence, Set
from typing import Any

import numpy as np

from ldo_service.geometry.keyframe_poses import RelativePose

from .component_merging import (
    T_new_old,
    best_bridge_removal,
    check_against_bridge,
    conflicting_bridges,
)
from .condensation import group_to_condense
from .factor_store import FactorStore
from .factors import (
    BoxObservation,
    information,
    pack_observations,
    pack_relative,
    unpack_observations,
    unpack_relative,
)
from .loop_closures import ClosureDecision, LoopClosureSet, Pair, pair_of
from .pose_graph_config import PoseGraphConfig
from .solver import Name, Solver, Variables, point_key


class PoseGraph:
    """Pose graph of keyframes and landmarks, solved incrementally by iSAM2.

    The solver minimizes the cost F of keyframe poses and landmark positions. The package docstring
    gives the formula of F. Keyframes that measurements connect form a component, whose first
    keyframe stays fixed. A measurement between two components merges them in the older one's frame.

    The state of iSAM2 cannot be saved, and a new solver with the same measurements differs in the
    last digits. Therefore a snapshot contains the values at the last rebuild of the solver and all
    changes since then. A restored graph repeats these changes and gives bitwise equal results. The
    solver is rebuilt when keyframes are condensed, after `max_changes` changes, and when an update
    of iSAM2 fails. The same calls in the same order give bitwise equal results.
    """

    def __init__(self, config: PoseGraphConfig | None = None) -> None:
        self._config = config = config or PoseGraphConfig()
        self._known = FactorStore(config.noise, config.closures)
        self._initial: Variables = {}  # Value with which each variable was added to the solver.
        self._solver = Solver()
        self._base = self._packed()
        self._changes: list[tuple[str, dict[str, Any]]] = []  # Changes since the last rebuild.
        self.solved_times = 0

    def __contains__(self, keyframe: int) -> bool:
        return keyframe in self._known.first_of

    def __len__(self) -> int:
        return len(self._known.first_of)

    @property
    def keyframes(self) -> Set[int]:
        return self._known.first_of.keys()

    @property
    def newest(self) -> int | None:
        return max(self.keyframes, default=None)

    @property
    def variables(self) -> int:
        """Number of keyframes that are variables; the others are condensed."""
        return len(self) - len(self._known.rows)

    @property
    def closures(self) -> LoopClosureSet:
        """The set of accepted, rejected and removed loop closures."""
        return self._known.closures

    # --- keyframes --------------------------------------------------------------------------------
    def add_first(self, keyframe: int, T_map_keyframe: np.ndarray) -> None:
        """Add the first keyframe of a new component, fixed at T_map_keyframe [4, 4]."""
        self._log_change("first", keyframe=keyframe, T_map=T_map_keyframe)
        self._initial[keyframe] = np.array(T_map_keyframe, float)
        self._known.first_of[keyframe] = keyframe
        self._known.active.append(keyframe)
        self._update([("first", keyframe)], [keyframe])

    def component_root(self, keyframe: int) -> int:
        """Return the first keyframe of the component that contains a keyframe.

        Raises:
            KeyError: The keyframe is unknown.
        """
        return self._known.first_of[keyframe]

    def add(self, measured: RelativePose, *more: RelativePose) -> None:
        """Add a new keyframe `b` with its measurements from one or more known keyframes `a`.

        Raises:
            KeyError: A keyframe `a` is unknown.
            ValueError: The measurements have different keyframes `b`.
        """
        every = (measured, *more)
        if any(m.b != measured.b for m in every):
            raise ValueError(
                f"the measurements have several keyframes b, {sorted({m.b for m in every})}. One "
                "call adds one keyframe, so all measurements must have the same b."
            )
        self._require(m.a for m in every)
        self._log_change("add", measured=pack_relative(every))
        self._initial[measured.b] = self.pose(measured.a) @ measured.T_a_b
        self._known.first_of[measured.b] = self.component_root(measured.a)
        self._known.active.append(measured.b)
        self._update([self._known.add_measurement(m) for m in every], [measured.b])
        self._condense()

    def replace(self, measured: Sequence[RelativePose]) -> None:
        """Replace earlier measurements between the same keyframes by new ones.

        Raises:
            KeyError: A keyframe is unknown.
        """
        self._require(k for m in measured for k in (m.a, m.b))
        self._log_change("replace", measured=pack_relative(measured))
        names = [self._known.replace_measurement(m, self.pose) for m in measured]
        self._update([name for name in names if name], [])

    def odometry_fallback(self, a: int, b: int, T_a_b: np.ndarray) -> RelativePose:
        """Return the odometry pose T_a_b [4, 4] between two keyframes as a measurement.

        The measurement can connect `a` and `b` if keyframes between them were missed. It has more
        noise than a measurement by alignment; see `NoiseConfig.sigma_odometry_m`.
        """
        noise = self._config.noise
        own = information(noise.sigma_odometry_rad, noise.sigma_odometry_m)
        return RelativePose(a, b, T_a_b, own)

    def _require(self, keyframes: Iterable[int]) -> None:
        for keyframe in keyframes:
            if keyframe not in self:
                raise KeyError(keyframe)

    # --- components and loops ---------------------------------------------------------------------
    def add_loop_closure(self, closure: RelativePose) -> ClosureDecision:
        """Check a loop closure between known keyframes, and add it if it is accepted.

        A rejected closure does not change any pose (see `loop_closures`). A closure between two
        components cannot be checked. It is accepted and merges the components, but later closures
        may replace it (see `component_merging`).

        Returns:
            The decision, which also names the earlier closures that are removed.

        Raises:
            KeyError: A keyframe is unknown.
        """
        if self.component_root(closure.a) != self.component_root(closure.b):
            self._merge_components(closure)
            return ClosureDecision(True)
        if pair_of(closure) in self._known.bridges:
            # The bridge edge uses the same two images, which must not count twice.
            return ClosureDecision(True)
        start, known = self._solver.variables(), self._known
        if known.relative_to_start(closure.a)[0] == known.relative_to_start(closure.b)[0]:
            # Both keyframes belong to the same condensed group, so no factor can connect them.
            return self._reject(closure)
        decision, variables = check_against_bridge(known, closure, start, self._initial)
        self.solved_times += 1
        if not decision.changes:
            return self._reject(closure)
        known.closures = known.closures.with_decision(closure, decision)
        self._restart_solver(self._with_ends(closure, variables))
        return decision

    def _with_ends(self, closure: RelativePose, variables: Variables) -> Variables:
        """Turn condensed keyframes of a closure back into variables if the closure moves them far.

        The limit is `max_interpolation_sigmas`, in standard deviations of a loop closure. A
        keyframe stays condensed if there are too many groups of condensed keyframes
        (`keyframes_each`).

        Returns:
            The given `variables` of the solution with this closure, and the poses of the keyframes
            that are variables again.
        """
        known, config = self._known, self._config
        for keyframe in (closure.a, closure.b):
            is_room = len(known.condensed) * config.keyframes_each < len(self)
            error_sigmas = known.interpolation_error_sigmas(keyframe, variables)
            if is_room and error_sigmas > config.max_interpolation_sigmas:
                T_map = known.interpolated.pose_at(known.rows[keyframe], variables.__getitem__)
                known.restore_variable(keyframe)
                variables = {**variables, keyframe: T_map}
        return variables

    def _merge_components(self, measured: RelativePose) -> None:
        """Merge the components of both keyframes in the frame of the older one, and solve again."""
        first_a, first_b = self.component_root(measured.a), self.component_root(measured.b)
        moves = T_new_old(measured, self.pose, moves_b=first_a < first_b)
        younger, older = max(first_a, first_b), min(first_a, first_b)
        moved = self._known.move_component(younger, older, moves, self._solver.variables())
        self._known.bridges[measured.a, measured.b] = measured
        self._restart_solver(moved)

    def _reject(self, closure: RelativePose) -> ClosureDecision:
        """Reject a closure, or replace a bridge edge that it contradicts.

        The closure replaces the bridge edge if more closures agree with this closure than with the
        edge; see `best_bridge_removal`.
        """
        known, variables = self._known, self._solver.variables()
        known.closures = known.closures.with_decision(closure, ClosureDecision(False))
        bridges = conflicting_bridges(known, closure)
        self._log_change("refuse", measured=pack_relative([closure]), is_doubt=bool(bridges))
        if not bridges:
            return ClosureDecision(False)
        known.keep_rejected(closure)
        better = best_bridge_removal(known, bridges, closure, self.pose, variables, self._initial)
        if better is None:
            return ClosureDecision(False)
        bridge, self._known, variables = better
        self._restart_solver(variables)
        gone = (p for p in known.closures.accepted if p not in self.closures.accepted)
        return ClosureDecision(True, (bridge.pair, *gone))

    # --- landmarks --------------------------------------------------------------------------------
    def add_observations(
        self, boxes: Sequence[BoxObservation], placed: Mapping[int, np.ndarray]
    ) -> None:
        """Add observations of landmarks in known keyframes.

        Args:
            boxes: The observations.
            placed: Position [3] in the map, meters, of each new landmark that `boxes` observe, by
                landmark id.

        Raises:
            KeyError: A keyframe is unknown.
        """
        self._require(s.keyframe for s in boxes)
        self._log_change(
            "see", sights=pack_observations(boxes), ids=list(placed), points=list(placed.values())
        )
        self._initial |= {point_key(k): np.array(p, float) for k, p in placed.items()}
        self._known.observations |= {(s.keyframe, s.landmark): s for s in boxes}
        names = [("sight", s.keyframe, s.landmark) for s in boxes]
        self._update(names, [point_key(k) for k in placed])

    def remove_observations(self, pairs: Iterable[Pair]) -> None:
        """Remove observations, and landmarks that have no observation left.

        Args:
            pairs: Keyframe and landmark of each observation; unknown pairs are ignored.
        """
        known = [pair for pair in pairs if pair in self._known.observations]
        if not known:
            return
        self._log_change("unsee", pairs=[list(pair) for pair in known])
        for pair in known:
            del self._known.observations[pair]
        left = {landmark for _, landmark in self._known.observations}
        for landmark in {landmark for _, landmark in known} - left:
            self._initial.pop(point_key(landmark), None)
        self._update([], [], [("sight", *pair) for pair in known])

    def has_landmark(self, landmark: int) -> bool:
        """Return whether a landmark is a variable of the graph."""
        return point_key(landmark) in self._initial

    def landmarks(self) -> dict[int, np.ndarray]:
        """Return the position [3] of each landmark in the map, meters, by id."""
        variables = self._solver.variables()
        return {
            k: variables[point_key(k)] for k in sorted({k for _, k in self._known.observations})
        }

    # --- poses ------------------------------------------------------------------------------------
    def pose(self, keyframe: int) -> np.ndarray:
        """Return the current estimate of T_map_keyframe [4, 4]."""
        row = self._known.rows.get(keyframe)
        if row is None:
            return self._solver.pose(keyframe)
        return self._known.interpolated.pose_at(row, self._solver.pose)

    def poses(self) -> dict[int, np.ndarray]:
        """Return T_map_keyframe [4, 4] of every keyframe, by id, ascending."""
        keyframes, T_map = self.all_poses()
        return dict(zip(keyframes.tolist(), T_map, strict=True))

    def all_poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the ids of all keyframes [K], ascending, and T_map_keyframe [K, 4, 4]."""
        variables = self._solver.variables()
        keys = np.array([k for k in variables if k in self], np.int64)
        T_map = np.array([variables[k] for k in keys.tolist()]).reshape(-1, 4, 4)
        return self._known.interpolated.poses_with_variables(keys, T_map)

    # --- iSAM2 ------------------------------------------------------------------------------------
    def _update(
        self, names: Sequence[Name], variables: Sequence[int], gone: Sequence[Name] = ()
    ) -> None:
        if not names and not gone:
            return
        self.solved_times += 1
        factors = {name: self._known.factor(name, self._initial) for name in names}
        try:
            self._solver.update(factors, {k: self._initial[k] for k in variables}, gone)
        except RuntimeError:
            self._rebuild_or_forget_landmarks()

    def _rebuild_or_forget_landmarks(self) -> None:
        """Rebuild the solver; if that fails, remove all landmarks and rebuild it again.

        A landmark with nearly parallel rays can make the equations singular.
        """
        try:
            self._rebuild()
        except RuntimeError:
            self._known.observations = {}
            self._initial = {k: v for k, v in self._initial.items() if v.ndim == 2}
            self._rebuild()

    def _rebuild(self) -> None:
        """Solve all measurements in a new solver.

        Raises:
            RuntimeError: The measurements do not determine all variables.
        """
        factors = {name: self._known.factor(name, self._initial) for name in self._known.names()}
        self._solver = Solver()
        if factors:
            self._solver.update(factors, self._initial)

    def _condense(self) -> None:
        """Condense the next group of keyframes, if enough keyframes have left the window.

        The solver is rebuilt after a condensation, and after `max_changes` changes.
        """
        config, known = self._config, self._known
        heads = {k for pair in known.condensed for k in pair}
        group = group_to_condense(
            known.active, known.odometry, heads, config.condense_keyframes, config.window_keyframes
        )
        if group:
            known.condense(group, {k: self.pose(k) for k in group})
        if group or len(self._changes) > config.max_changes:
            variables = self._solver.variables().items()
            self._restart_solver({k: v for k, v in variables if k not in known.rows})

    def _restart_solver(self, variables: Variables) -> None:
        """Rebuild the solver from the given values, and start a new list of changes."""
        self._initial, self._changes = variables, []
        self._base = self._packed()
        self._rebuild_or_forget_landmarks()

    # --- state ------------------------------------------------------------------------------------
    def _log_change(self, change: str, **what: Any) -> None:
        self._changes.append((change, what))

    def _packed(self) -> dict[str, Any]:
        initial = list(self._initial), [v.ravel() for v in self._initial.values()]
        return {"keys": initial[0], "values": initial[1], "known": self._known.pack()}

    def snapshot(self) -> dict[str, Any]:
        """Return the state at the last rebuild of the solver (`base`), and the changes after it."""
        # Snapshots between two rebuilds share one object `base`.
        return {"base": self._base, "changes": list(self._changes)}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore a snapshot; later results are bitwise equal to those of the saved graph."""
        self._base, self._changes = state["base"], []
        values = [v.reshape(4, 4) if v.size == 16 else v for v in self._base["values"]]
        self._initial = dict(zip(self._base["keys"], values, strict=True))
        self._known.unpack(self._base["known"])
        self._rebuild_or_forget_landmarks()
        for change, what in state["changes"]:
            self._replay_change(change, what)

    def _replay_change(self, change: str, what: Mapping[str, Any]) -> None:
        match change:
            case "first":
                self.add_first(what["keyframe"], what["T_map"])
            case "add":
                self.add(*unpack_relative(what["measured"]))
            case "replace":
                self.replace(unpack_relative(what["measured"]))
            case "see":
                points = dict(zip(what["ids"], what["points"], strict=True))
                self.add_observations(unpack_observations(what["sights"]), points)
            case "unsee":
                self.remove_observations(
                    [(keyframe, landmark) for keyframe, landmark in what["pairs"]]
                )
            case "refuse":
                (closure,) = unpack_relative(what["measured"])
                self._log_change(change, **what)
                self._known.closures = self._known.closures.with_decision(
                    closure, ClosureDecision(False)
                )
                if what["is_doubt"]:
                    self._known.keep_rejected(closure)
