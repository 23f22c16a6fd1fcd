"""Adam on the Gaussians that a view reaches. The kernel is `kernels/adam.cpp`."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from weakref import ref

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.kernels import _adam

from .model import GaussianMap, aligned_rows
from .renderer import AdamStep, Rasterizer, RowGradients, VisibleGaussians


@dataclass(frozen=True, slots=True)
class AdamConfig:
    """Step lengths per iteration. 5 to 10 times those of 3DGS, because a keyframe gets tens of
    iterations and not thousands (ALGORITHMS: 4.5 s of the usual rates are reached in 0.35 s)."""

    mean_m: float = 5e-4
    log_scale: float = 0.06
    quat: float = 0.01
    opacity_logit: float = 0.1
    color: float = 0.01
    beta1: float = 0.9  # Kingma and Ba 2015
    beta2: float = 0.95  # usual 0.999 remembers longer than a keyframe is worked on
    epsilon: float = 1e-15  # as 3DGS: gradients are means over pixels, about 1e-7

    def __post_init__(self) -> None:
        rates = (self.mean_m, self.log_scale, self.quat, self.opacity_logit, self.color)
        if not min(rates) >= 0:
            raise ConfigError(
                named(self, "mean_m", "log_scale", "quat", "opacity_logit", "color")
                + ": learning rates must not be negative."
            )
        if not (0 <= self.beta1 < 1 and 0 <= self.beta2 < 1 and self.epsilon > 0):
            raise ConfigError(
                named(self, "beta1", "beta2", "epsilon")
                + ": betas must lie in [0, 1), epsilon above 0."
            )

    def rates(self) -> np.ndarray:
        """Per field of a row [16] float32."""
        groups = ((self.mean_m, 3), (self.log_scale, 3), (self.quat, 4), (self.opacity_logit, 1))
        out = [rate for rate, n in (*groups, (self.color, 3), (0.0, 2)) for _ in range(n)]
        return np.array(out, np.float32)


class Adam:
    """Moments of the gradients beside the rows of a map, found by the Gaussians' ids.

    A Gaussian that no view reaches neither moves nor ages: each has a step count of its own.
    """

    def __init__(self, config: AdamConfig | None = None) -> None:
        self.config = config or AdamConfig()
        self._rates = self.config.rates()
        self._ids = np.zeros(0, np.int64)
        self._moments = [aligned_rows(0), aligned_rows(0)]  # with room to grow
        self._steps = np.zeros(0, np.int32)
        self._followed: tuple[ref[GaussianMap], int] | None = None  # whose ids, and which of them

    def step(
        self,
        gaussians: GaussianMap,
        gradients: RowGradients,
        *,
        rate: float = 1.0,
        threads: int = 1,
    ) -> None:
        """One step against the gradients, in place, `rate` times as long as configured.

            m <- b1 m + (1 - b1) g,  v <- b2 v + (1 - b2) g^2
            row <- row - rate (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + epsilon)

        Gaussians without any gradient (hidden, or not in `indices`) stay as they are.
        Kingma and Ba, 2015, algorithm 1. Bitwise equal for any number of threads.
        """
        step = self._step(gaussians, rate)
        _adam.adam_step(
            step.rows,
            step.mean,
            step.square,
            step.steps,
            gradients.indices,
            gradients.rows,
            step.rates,
            step.beta1,
            step.beta2,
            step.epsilon,
            threads,
        )
        gaussians.touch(gradients.indices)

    def step_fused(
        self,
        gaussians: GaussianMap,
        rasterizer: Rasterizer,
        by_planes: np.ndarray,
        *,
        rate: float = 1.0,
        needle_weight: float = 0.0,
        needle_ratio: float = 1.0,
        max_sigma_px: float = inf,
    ) -> VisibleGaussians:
        """`step` against the gradients of what `rasteriser` last rendered of this map, which are
        never written out; `Rasterizer` says what `by_planes`, needles and `max_sigma_px` are."""
        reached = rasterizer.descend(
            by_planes,
            self._step(gaussians, rate),
            needle_weight=needle_weight,
            needle_ratio=needle_ratio,
            max_sigma_px=max_sigma_px,
        )
        gaussians.touch(reached.indices)
        return reached

    def _step(self, gaussians: GaussianMap, rate: float) -> AdamStep:
        self._follow(gaussians)
        config, n = self.config, len(gaussians)
        mean, square = (moment[:n] for moment in self._moments)
        rates = self._rates * np.float32(rate)
        betas = config.beta1, config.beta2
        return AdamStep(gaussians.rows, mean, square, self._steps, rates, *betas, config.epsilon)

    def steps(self, gaussians: GaussianMap) -> np.ndarray:
        """[N] int32, how many steps each Gaussian has made. A view."""
        self._follow(gaussians)
        return self._steps

    def snapshot(self) -> dict[str, np.ndarray]:
        """A copy of everything, as named arrays."""
        mean, square = (moment[: len(self._ids)].copy() for moment in self._moments)
        return {
            "ids": self._ids.copy(),
            "mean": mean,
            "square": square,
            "steps": self._steps.copy(),
        }

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Become what `state` is the snapshot of, exactly."""
        self._followed = None
        self._ids, self._steps = state["ids"].copy(), state["steps"].copy()
        self._reserve(len(self._ids))
        for moment, saved in zip(self._moments, (state["mean"], state["square"]), strict=True):
            moment[: len(saved)], moment[len(saved) :] = saved, 0

    def _follow(self, gaussians: GaussianMap) -> None:
        """Forget the Gaussians that went; those that came, or came back, begin with zeros."""
        followed = ref(gaussians), gaussians.membership
        if followed == self._followed:
            return
        self._followed = followed
        self._match(gaussians.ids)

    def _match(self, ids: np.ndarray) -> None:
        n = len(self._ids)
        if not np.array_equal(ids[:n], self._ids):
            self._sort_out(ids)
        elif len(ids) == n:
            return
        self._reserve(len(ids))
        grown = np.zeros(len(ids) - len(self._steps), np.int32)
        self._steps = np.concatenate([self._steps, grown])
        self._ids = ids.copy()

    def _sort_out(self, ids: np.ndarray) -> None:
        """Bring the state of the Gaussians that stay to their new places; zeros elsewhere."""
        n = len(self._ids)
        old_places = np.searchsorted(self._ids, ids)
        stays = np.append(self._ids, -1)[old_places] == ids
        old_places, places = old_places[stays], np.flatnonzero(stays)
        steps, self._steps = self._steps, np.zeros(len(ids), np.int32)
        self._steps[places] = steps[old_places]
        self._reserve(len(ids))
        for moment in self._moments:
            kept = moment[old_places]
            moment[: max(n, len(ids))] = 0
            moment[places] = kept

    def _reserve(self, n: int) -> None:
        for k, moment in enumerate(self._moments):
            if n > len(moment):
                self._moments[k] = aligned_rows(max(n, 2 * len(moment)))
                self._moments[k][: len(moment)] = moment
