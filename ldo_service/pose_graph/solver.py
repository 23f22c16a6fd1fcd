"""iSAM2 over named factors, and the same from scratch. Deterministic: equal calls, equal bits."""

from collections.abc import Iterable, Mapping
from typing import Any

import gtsam
import numpy as np

Name = tuple[Any, ...]  # of a factor: its kind, then the ids of what it is between
Variables = dict[int, np.ndarray]  # by key: T_map_keyframe [4, 4], or a point [3] in the map


class Solver:
    """min sum of factors, relinearising what moved; factors come and go by name."""

    def __init__(self) -> None:
        solver = gtsam.ISAM2GaussNewtonParams()
        solver.setWildfireThreshold(0.0)  # 0.001 by default: smaller changes would not be passed on
        parameters = gtsam.ISAM2Params()
        parameters.setOptimizationParams(solver)
        parameters.findUnusedFactorSlots = True  # or the list grows with every replacement
        parameters.setRelinearizeThreshold(0.01)  # rad and m, gtsam's advice for poses
        parameters.relinearizeSkip = 1
        self._isam = gtsam.ISAM2(parameters)
        self._places: dict[Name, int] = {}

    def update(
        self,
        factors: Mapping[Name, gtsam.NonlinearFactor],
        variables: Variables,
        gone: Iterable[Name] = (),
    ) -> None:
        """New factors and variables in, factors of the names `gone` out, and with the last factor
        of a variable the variable. A name that is known is replaced.

        Raises RuntimeError where they do not say where every variable is; the solver is of no use
        then.
        """
        out = {*gone, *factors} & self._places.keys()
        places = sorted(self._places.pop(name) for name in out)
        result = self._isam.update(graph_of(factors.values()), values_of(variables), places)
        self._places.update(zip(factors, result.getNewFactorsIndices(), strict=True))

    def pose(self, key: int) -> np.ndarray:
        """T_map_keyframe [4, 4], as estimated now."""
        return self._isam.calculateEstimatePose3(key).matrix()

    def variables(self) -> Variables:
        """All, as estimated now, ascending by key."""
        return variables_of(self._isam.calculateEstimate())


def solve_batch(
    factors: Iterable[gtsam.NonlinearFactor], start: Variables
) -> tuple[Variables, float]:
    """From scratch, by Levenberg-Marquardt from `start`: the variables, and sum |error / sigma|^2
    there. Raises RuntimeError as `update`."""
    graph = graph_of(factors)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-7)
    values = gtsam.LevenbergMarquardtOptimizer(graph, values_of(start), parameters).optimize()
    return variables_of(values), 2 * graph.error(values)


def graph_of(factors: Iterable[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph


def values_of(variables: Variables) -> gtsam.Values:
    values = gtsam.Values()
    for key, value in variables.items():
        values.insert(key, gtsam.Pose3(value) if value.ndim == 2 else value)
    return values


def variables_of(values: gtsam.Values) -> Variables:
    """Keyframes have smaller keys than points, and both come in the order of their keys."""
    rows = gtsam.utilities.extractPose3(values).reshape(-1, 12)
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = rows[:, :9].reshape(-1, 3, 3), rows[:, 9:]
    points = gtsam.utilities.extractPoint3(values).reshape(-1, 3)
    return dict(zip(values.keys(), (*T, *points), strict=True))


def point_key(landmark: int) -> int:
    return gtsam.symbol("o", landmark)
