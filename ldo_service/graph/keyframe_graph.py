"""Keyframe poses from relative measurements, by incremental smoothing (iSAM2)."""

from collections.abc import Sequence, Set
from dataclasses import dataclass

import gtsam
import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3
from ldo_service.geometry.relative_pose import RelativePose


@dataclass(frozen=True, slots=True)
class KeyframeGraphConfig:
    first_sigma: float = 1e-6  # rad and m: the first keyframe is the origin of its component
    sigma_rotation_max_rad: float = 0.2  # a degenerate direction is believed no worse than this,
    sigma_translation_max_m: float = 0.5  # or the linear system becomes singular
    sigma_odometry_rad: float = 0.05  # of odometry over a missed keyframe
    sigma_odometry_m: float = 0.1

    def __post_init__(self) -> None:
        if min(getattr(self, name) for name in self.__slots__) <= 0:
            raise ConfigError(f"{self}: every sigma must be positive.")


class KeyframeGraph:
    """min over T_map_k of  sum |log(T_a_b^-1 T_map_a^-1 T_map_b)|^2_information.

    Keyframes that measurements connect are a component, whose frame its first keyframe fixes; a
    measurement between two components makes them one, in the frame of the older.

    iSAM2 relinearises what moved. An update that throws has already changed the object, so the
    graph is rebuilt from the kept measurements. Deterministic: the same measurements in the same
    order give the same bits.
    """

    def __init__(self, config: KeyframeGraphConfig = KeyframeGraphConfig()) -> None:
        self._config = config
        self._floor = np.diag(
            [config.sigma_rotation_max_rad**-2] * 3 + [config.sigma_translation_max_m**-2] * 3
        )
        self._initial: dict[int, np.ndarray] = {}  # the value each keyframe was inserted with
        self._measured: dict[tuple[int, int], RelativePose] = {}
        self._places: dict[tuple[int, int], int] = {}  # of their factors in the solver
        self._first_of: dict[int, int] = {}  # the first keyframe of each one's component
        self._isam = self._new_isam()

    def __contains__(self, keyframe: int) -> bool:
        return keyframe in self._initial

    def __len__(self) -> int:
        return len(self._initial)

    @property
    def keyframes(self) -> Set[int]:
        return self._initial.keys()

    @property
    def newest(self) -> int | None:
        return max(self._initial, default=None)

    def add_first(self, keyframe: int, T_map_keyframe: np.ndarray) -> None:
        """The keyframe that fixes the frame of a new component."""
        self._initial[keyframe] = np.array(T_map_keyframe, float)
        self._first_of[keyframe] = keyframe
        self._update([], [keyframe])

    def first_of(self, keyframe: int) -> int:
        """The first keyframe of its component. Raises KeyError when it is not known."""
        return self._first_of[keyframe]

    def add(self, measured: RelativePose, *more: RelativePose) -> None:
        """A new keyframe `b`, measured from a known one, and from `more` of them.

        Raises KeyError for an `a` that is not known, ValueError if they measure several keyframes.
        """
        every = (measured, *more)
        if any(m.b != measured.b for m in every):
            raise ValueError(f"keyframes {sorted({m.b for m in every})} cannot be added at once.")
        for m in every:
            if m.a not in self:
                raise KeyError(m.a)
        self._initial[measured.b] = self.pose(measured.a) @ measured.T_a_b
        self._first_of[measured.b] = self._first_of[measured.a]
        self._measured.update({(m.a, m.b): m for m in every})
        self._update(every, [measured.b])

    def replace(self, measured: Sequence[RelativePose]) -> None:
        """Believe these in place of what was measured between the same keyframes before.

        Raises KeyError for a keyframe that is not known.
        """
        for m in measured:
            if m.a not in self or m.b not in self:
                raise KeyError((m.a, m.b))
        old = [self._places[m.a, m.b] for m in measured if (m.a, m.b) in self._places]
        self._measured.update({(m.a, m.b): m for m in measured})
        self._update(measured, [], old)

    def connect(self, measured: RelativePose) -> None:
        """A measurement between two known keyframes. Raises KeyError when one is not known.

        When it joins two components, the younger one moves as a whole into the older one's frame,
        T_new_old = T_map_a T_a_b T_map_b^-1 (or its inverse), before everything is solved again.
        """
        first_a, first_b = self._first_of[measured.a], self._first_of[measured.b]
        if first_a == first_b:
            self.replace([measured])
            return
        T_new_old = self.pose(measured.a) @ measured.T_a_b @ se3.inverse(self.pose(measured.b))
        if first_a > first_b:
            T_new_old = se3.inverse(T_new_old)
        self._move(max(first_a, first_b), min(first_a, first_b), se3.orthonormalised(T_new_old))
        self._measured[measured.a, measured.b] = measured
        self._rebuild()

    def _move(self, younger: int, older: int, T_new_old: np.ndarray) -> None:
        """All of a component into another; everything is solved from where it is now."""
        self._initial = poses = self.poses()
        for keyframe in [k for k, first in self._first_of.items() if first == younger]:
            self._initial[keyframe] = T_new_old @ poses[keyframe]
            self._first_of[keyframe] = older

    def missed_odometry(self, a: int, b: int, T_a_b: np.ndarray) -> RelativePose:
        """Odometry between keyframes of which those between were missed: believed less."""
        sigmas = [self._config.sigma_odometry_rad] * 3 + [self._config.sigma_odometry_m] * 3
        return RelativePose(a, b, T_a_b, np.diag(np.array(sigmas) ** -2))

    def pose(self, keyframe: int) -> np.ndarray:
        """T_map_keyframe [4, 4], as estimated now."""
        return self._isam.calculateEstimatePose3(keyframe).matrix()

    def poses(self) -> dict[int, np.ndarray]:
        """T_map_keyframe of every keyframe, ascending by id."""
        estimate = self._isam.calculateEstimate()
        return {k: estimate.atPose3(k).matrix() for k in sorted(self._initial)}

    # --- iSAM2 ------------------------------------------------------------------------------------
    def _new_isam(self) -> gtsam.ISAM2:
        solver = gtsam.ISAM2GaussNewtonParams()
        solver.setWildfireThreshold(0.0)  # 0.001 by default: smaller changes would not be passed on
        parameters = gtsam.ISAM2Params()
        parameters.setOptimizationParams(solver)
        parameters.findUnusedFactorSlots = True  # or the list grows with every replacement
        parameters.setRelinearizeThreshold(0.01)  # rad and m, gtsam's advice for poses
        parameters.relinearizeSkip = 1
        return gtsam.ISAM2(parameters)

    def _update(
        self,
        measured: Sequence[RelativePose],
        keyframes: Sequence[int],
        old_places: Sequence[int] = (),
    ) -> None:
        try:
            self._apply(measured, keyframes, old_places)
        except RuntimeError:
            self._rebuild()

    def _apply(
        self,
        measured: Sequence[RelativePose],
        keyframes: Sequence[int],
        old_places: Sequence[int] = (),
    ) -> None:
        """New factors and keyframes in, the factors at `old_places` out."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for m in measured:
            graph.add(self._factor(m))
        for keyframe in keyframes:
            values.insert(keyframe, gtsam.Pose3(self._initial[keyframe]))
        for keyframe in keyframes:
            if self._first_of[keyframe] == keyframe:
                graph.add(self._first_factor(keyframe))
        places = self._isam.update(graph, values, list(old_places)).getNewFactorsIndices()
        self._places.update({(m.a, m.b): place for m, place in zip(measured, places, strict=False)})

    def _rebuild(self) -> None:
        """All measurements into a new object. Raises RuntimeError when they cannot be solved."""
        self._isam = self._new_isam()
        self._apply(list(self._measured.values()), list(self._initial))

    def _first_factor(self, keyframe: int) -> gtsam.NonlinearFactor:
        noise = gtsam.noiseModel.Isotropic.Sigma(6, self._config.first_sigma)
        return gtsam.PriorFactorPose3(keyframe, gtsam.Pose3(self._initial[keyframe]), noise)

    def _factor(self, measured: RelativePose) -> gtsam.NonlinearFactor:
        information = 0.5 * (measured.information + measured.information.T) + self._floor
        return gtsam.BetweenFactorPose3(
            measured.a,
            measured.b,
            gtsam.Pose3(measured.T_a_b),
            gtsam.noiseModel.Gaussian.Information(information),
        )

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, np.ndarray]:
        keyframes = sorted(self._initial)
        measured = self._measured.values()
        return {
            "keyframes": np.array(keyframes, np.int64),
            "first_of": np.array([self._first_of[k] for k in keyframes], np.int64),
            "initial": np.array([self._initial[k] for k in keyframes]).reshape(-1, 4, 4),
            "pairs": np.array([(m.a, m.b) for m in measured], np.int64).reshape(-1, 2),
            "T_a_b": np.array([m.T_a_b for m in measured]).reshape(-1, 4, 4),
            "information": np.array([m.information for m in measured]).reshape(-1, 6, 6),
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        keyframes = [int(k) for k in state["keyframes"]]
        self._initial = dict(zip(keyframes, state["initial"], strict=True))
        self._first_of = dict(zip(keyframes, map(int, state["first_of"]), strict=True))
        self._measured = {
            (int(a), int(b)): RelativePose(int(a), int(b), T_a_b, information)
            for (a, b), T_a_b, information in zip(
                state["pairs"], state["T_a_b"], state["information"], strict=True
            )
        }
        if keyframes:
            self._rebuild()
