"""Adam optimizer for the Gaussians visible in one image. The kernel is `kernels/adam.cpp`."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf, sqrt
from weakref import ref

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.kernels import _adam

from .model import GaussianMap
from .renderer import AdamStep, Rasterizer, RowGradients, VisibleGaussians
from .rows import aligned_rows, keep_rows

# Mean color error of an image, 0..1, at which the learning rates apply as configured. The mean
# errors are 0.007 in synthetic scenes and 0.04 in the sequence kitchen. With twice the rates in all
# iterations, at an effort of 2, the kitchen gains 0.9 dB, but an apartment loses 1.4 dB.
USUAL_L1 = 0.0125
# Largest factor on the learning rates. An image of unmapped surface would give up to 9.
MAX_FACTOR = 3.0


@dataclass(frozen=True, slots=True)
class AdamConfig:
    """Learning rates of Adam for each parameter of a Gaussian.

    A rate approximates the change of its parameter in one step. The rates are 5 to 10 times as high
    as in 3DGS, because a keyframe gets tens of iterations instead of thousands. On a CPU, 0.35 s of
    optimization reach the quality that takes 4.5 s with the rates of 3DGS.
    """

    mean_m: float = 5e-4
    log_scale: float = 0.06
    quat: float = 0.01
    opacity_logit: float = 0.1
    color: float = 0.01
    beta1: float = 0.9  # Kingma and Ba, 2015.
    beta2: float = 0.95  # The usual 0.999 averages over more iterations than a keyframe gets.
    # Value of 3DGS. It is this small because gradients are means over pixels, about 1e-7.
    epsilon: float = 1e-15

    def __post_init__(self) -> None:
        rates = (self.mean_m, self.log_scale, self.quat, self.opacity_logit, self.color)
        if not min(rates) >= 0:
            raise ConfigError(
                named(self, "mean_m", "log_scale", "quat", "opacity_logit", "color")
                + ": all learning rates must be at least 0."
            )
        if not (0 <= self.beta1 < 1 and 0 <= self.beta2 < 1 and self.epsilon > 0):
            raise ConfigError(
                named(self, "beta1", "beta2", "epsilon")
                + ": beta1 and beta2 must lie in [0, 1), and epsilon must be positive."
            )

    def rates(self) -> np.ndarray:
        """Return the learning rates of the 16 columns of a Gaussian's row, [16] float32.

        `gaussians.rows` lists the columns.
        """
        groups = ((self.mean_m, 3), (self.log_scale, 3), (self.quat, 4), (self.opacity_logit, 1))
        out = [rate for rate, n in (*groups, (self.color, 3), (0.0, 2)) for _ in range(n)]
        return np.array(out, np.float32)


def residual_factor(l1: float) -> float:
    """Return the factor on all learning rates at a mean color error `l1` of an image, 0..1.

    Steps of Adam hardly depend on the size of the gradient. With constant rates, they are thus too
    long for a map that nearly explains its images, and too short for one that does not. The factor
    is for the few iterations after a keyframe. A long refinement has rates that fall to a twentieth
    anyway, and shorter steps cost it 0.4 dB in an apartment.
    """
    return min(sqrt(l1 / USUAL_L1), MAX_FACTOR)


def places_of_remaining(old_ids: np.ndarray, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of the M Gaussians that remain after a change of the map.

    Args:
        old_ids: Ids of the Gaussians before the change, [K], ascending.
        ids: Ids of the Gaussians after the change, [N].

    Returns:
        Indices into `old_ids`, [M], and indices into `ids`, [M], of the same Gaussians.
    """
    old_places = np.searchsorted(old_ids, ids)
    stays = np.append(old_ids, -1)[old_places] == ids
    return old_places[stays], np.flatnonzero(stays)


class Adam:
    """Adam optimizer of a map, with moments and a step count for each Gaussian.

    A Gaussian that is invisible in an iteration does not change, and its moments do not decay.

    Attributes:
        matches: Counter that increases when the moments are matched to a map whose rows were added
            or removed.
        restores: Counter that increases when `restore` replaces the moments.
    """

    def __init__(self, config: AdamConfig | None = None) -> None:
        self.config = config or AdamConfig()
        self._rates = self.config.rates()
        self._ids = np.zeros(0, np.int64)
        self._moments = [aligned_rows(0), aligned_rows(0)]  # First, second; may have spare rows.
        self._steps = np.zeros(0, np.int32)
        self.matches = self.restores = 0
        # The map that `_ids` was last matched to, with its `membership` counter at that time.
        self._followed: tuple[ref[GaussianMap], int] | None = None

    def step(
        self,
        gaussians: GaussianMap,
        gradients: RowGradients,
        *,
        rate: float = 1.0,
        threads: int = 1,
    ) -> None:
        """Take one step against the gradients, in place.

            m <- b1 m + (1 - b1) g,  v <- b2 v + (1 - b2) g^2
            row <- row - rate (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + epsilon)

        This is algorithm 1 of Kingma and Ba, 2015: g is the gradient, m and v are the moments of g,
        t is the step count of the Gaussian, and b1 and b2 are `beta1` and `beta2` of `AdamConfig`.
        Gaussians that are hidden, or that are not in `gradients.indices`, stay as they are. The
        result is bitwise equal for any number of threads.

        Args:
            gaussians: The map; its rows change.
            gradients: Gradients of its visible rows.
            rate: Factor on the configured learning rates.
            threads: Number of threads of the kernel.
        """
        step = self.arguments(gaussians, rate)
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
        """Compute the gradients of the last rendering and take a step of Adam, in one pass.

        The result equals that of `Rasterizer.gradients` followed by `step`. One pass is faster,
        since no gradients are written to memory.

        Args:
            gaussians: The map; its rows change.
            rasterizer: The rasterizer that last rendered this map.
            by_planes: Derivatives of the loss with respect to the output of `Rasterizer.render`,
                [5, H, W].
            rate: Factor on the configured learning rates.
            needle_weight: Weight of the penalty on needle-shaped Gaussians; see
                `Rasterizer.gradients`.
            needle_ratio: Ratio of the longest to the middle axis above which the penalty applies.
            max_sigma_px: Limit on the standard deviations after the step, in pixels of the image.

        Returns:
            The Gaussians that may touch the rendered image.
        """
        reached = rasterizer.descend(
            by_planes,
            self.arguments(gaussians, rate),
            needle_weight=needle_weight,
            needle_ratio=needle_ratio,
            max_sigma_px=max_sigma_px,
        )
        gaussians.touch(reached.indices)
        return reached

    def arguments(self, gaussians: GaussianMap, rate: float = 1.0) -> AdamStep:
        """Return the kernel arguments of an Adam step on all rows of a map, without copying arrays.

        Args:
            gaussians: The map.
            rate: Factor on the configured learning rates.
        """
        self._follow(gaussians)
        config, n = self.config, len(gaussians)
        mean, square = (moment[:n] for moment in self._moments)
        rates = self._rates * np.float32(rate)
        betas = config.beta1, config.beta2
        return AdamStep(gaussians.rows, mean, square, self._steps, rates, *betas, config.epsilon)

    def steps(self, gaussians: GaussianMap) -> np.ndarray:
        """Return the number of Adam steps of each Gaussian, [N] int32, without a copy."""
        self._follow(gaussians)
        return self._steps

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return a copy of the state as named arrays."""
        mean, square = (moment[: len(self._ids)].copy() for moment in self._moments)
        return {
            "ids": self._ids.copy(),
            "mean": mean,
            "square": square,
            "steps": self._steps.copy(),
        }

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Restore the exact state that `snapshot` returned."""
        self._followed = None
        self.restores += 1
        self._ids, self._steps = state["ids"].copy(), state["steps"].copy()
        self._reserve(len(self._ids))
        for moment, saved in zip(self._moments, (state["mean"], state["square"]), strict=True):
            moment[: len(saved)], moment[len(saved) :] = saved, 0

    def _follow(self, gaussians: GaussianMap) -> None:
        """Match the moments and step counts to the rows of the map.

        Moments and counts of removed Gaussians are dropped. New Gaussians, and Gaussians loaded
        from disk, start with zeros.
        """
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
        self.matches += 1
        self._reserve(len(ids))
        grown = np.zeros(len(ids) - len(self._steps), np.int32)
        self._steps = np.concatenate([self._steps, grown])
        self._ids = ids.copy()

    def _sort_out(self, ids: np.ndarray) -> None:
        """Move moments and step counts of the remaining Gaussians to their new rows.

        All other rows become zero.
        """
        n, common = len(self._ids), min(len(self._ids), len(ids))
        differs = self._ids[:common] != ids[:common]
        first = int(np.argmax(differs)) if differs.any() else common  # Earlier rows stay in place.
        old_places, places = places_of_remaining(self._ids[first:], ids[first:])
        steps, self._steps = self._steps, np.zeros(len(ids), np.int32)
        self._steps[:first] = steps[:first]
        self._steps[first + places] = steps[first + old_places]
        self._reserve(len(ids))
        remaining = len(places)
        is_together = (
            remaining == 0 or places[-1] == remaining - 1
        )  # They have no new rows between them.
        for moment in self._moments:
            if is_together:
                keep_rows(moment, first, first + old_places)
                moment[first + remaining : max(n, len(ids))] = 0
            else:
                kept = moment[first + old_places]
                moment[first : max(n, len(ids))] = 0
                moment[first + places] = kept

    def _reserve(self, n: int) -> None:
        for k, moment in enumerate(self._moments):
            if n > len(moment):
                self._moments[k] = aligned_rows(max(n, 2 * len(moment)))
                self._moments[k][: len(moment)] = moment
