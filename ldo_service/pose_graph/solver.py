"""Incremental solver (iSAM2) for named factors, and a batch solver.

Equal calls give bitwise equal results.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import gtsam
import numpy as np

# Name of a factor: its kind, then the ids of its keyframes, or of its keyframe and landmark.
Name = tuple[Any, ...]
# Value of each variable by its gtsam key: T_map_keyframe [4, 4], or a point [3] in the map, meters.
Variables = dict[int, np.ndarray]


class Solver:
    """Incremental minimization of a sum of named factors by iSAM2.

    An update relinearizes the variables that have moved by more than 0.01 rad or 0.01 m.
    """

    def __init__(self) -> None:
        """Create a solver without variables."""
        solver = gtsam.ISAM2GaussNewtonParams()
        solver.setWildfireThreshold(0.0)  # The default 0.001 does not propagate smaller changes.
        parameters = gtsam.ISAM2Params()
        parameters.setOptimizationParams(solver)
        parameters.findUnusedFactorSlots = True  # Otherwise each replacement grows the list.
        parameters.setRelinearizeThreshold(0.01)  # rad and m; gtsam's recommendation for poses.
        parameters.relinearizeSkip = 1
        self._isam = gtsam.ISAM2(parameters)
        self._places: dict[Name, int] = {}

    def update(
        self,
        factors: Mapping[Name, gtsam.NonlinearFactor],
        variables: Variables,
        gone: Iterable[Name] = (),
    ) -> None:
        """Add factors and variables, and remove the factors named in `gone`.

        A factor replaces an existing one with the same name. A variable is removed together with
        its last factor.

        Raises:
            RuntimeError: The factors do not determine all variables. After this error, the solver
                can no longer be used.
        """
        out = {*gone, *factors} & self._places.keys()
        places = sorted(self._places.pop(name) for name in out)
        result = self._isam.update(graph_of(factors.values()), values_of(variables), places)
        self._places.update(zip(factors, result.getNewFactorsIndices(), strict=True))

    def pose(self, key: int) -> np.ndarray:
        """Return the current estimate of T_map_keyframe [4, 4]."""
        return self._isam.calculateEstimatePose3(key).matrix()

    def variables(self) -> Variables:
        """Return the current estimates of all variables, ascending by key."""
        return variables_of(self._isam.calculateEstimate())


def solve_batch(
    factors: Iterable[gtsam.NonlinearFactor], start: Variables
) -> tuple[Variables, float]:
    """Minimize the sum of factors by Levenberg-Marquardt from `start`.

    Returns:
        The variables at the minimum, and the sum of |error / sigma|^2 there.

    Raises:
        RuntimeError: The factors do not determine all variables.
    """
    graph = graph_of(factors)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-7)
    values = gtsam.LevenbergMarquardtOptimizer(graph, values_of(start), parameters).optimize()
    return variables_of(values), 2 * graph.error(values)


def graph_of(factors: Iterable[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    """Return the factors as a graph of gtsam."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph


def values_of(variables: Variables) -> gtsam.Values:
    """Return variables as values of gtsam."""
    values = gtsam.Values()
    for key, value in variables.items():
        values.insert(key, gtsam.Pose3(value) if value.ndim == 2 else value)
    return values


def variables_of(values: gtsam.Values) -> Variables:
    """Return values of gtsam as variables.

    The variables are in the order of their keys: first the keyframes, then the landmarks.
    """
    rows = gtsam.utilities.extractPose3(values).reshape(-1, 12)
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = rows[:, :9].reshape(-1, 3, 3), rows[:, 9:]
    points = gtsam.utilities.extractPoint3(values).reshape(-1, 3)
    return dict(zip(values.keys(), (*T, *points), strict=True))


def point_key(landmark: int) -> int:
    """Return the gtsam key of a landmark's variable, from the id of the landmark."""
    return gtsam.symbol("o", landmark)
